"""What training clips are cut from."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, UInt8

from vpd_lightning.data.driven_motion import DrivenMotion


@runtime_checkable
class FrameSource(Protocol):
    """The images and cameras of one trajectory, wherever they are kept."""

    @property
    def path(self) -> Path: ...

    @property
    def use_cache(self) -> bool: ...

    @property
    def num_frames(self) -> int: ...

    @property
    def num_views(self) -> int: ...

    @property
    def height(self) -> int: ...

    @property
    def width(self) -> int: ...

    def rgb(self, times: Sequence[int], views: Sequence[int]) -> UInt8[np.ndarray, "time view height width 3"]:
        """Return the colours of the given frames and views."""

    def depth(self, times: Sequence[int], views: Sequence[int]) -> Float32[np.ndarray, "time view height width"]:
        """Return the z-depths in metres of the given frames and views; 0 or non-finite where nothing was measured."""

    def cameras(
        self, times: Sequence[int], views: Sequence[int]
    ) -> tuple[Float[np.ndarray, "time view 3 3"], Float[np.ndarray, "time view 4 4"]]:
        """Return (intrinsics in pixels, cam_to_world in metres) in float64."""

    def driven(self, times: Sequence[int]) -> DrivenMotion | None:
        """Return the given motion at the given frames; None where the recording has none."""
