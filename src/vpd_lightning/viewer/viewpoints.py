"""Where the viewer draws from: the browser's own camera, or a recorded one."""

import math
from abc import ABC, abstractmethod
from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from vpd_lightning.media.camera_paths import resized
from vpd_lightning.types import Cameras


class Viewpoint(ABC):
    """A camera without a resolution."""

    @property
    @abstractmethod
    def key(self) -> Hashable:
        """Equal for viewpoints that see the same."""

    @abstractmethod
    def cameras(self, rows: int) -> Cameras:
        """Return the camera (axis ``view`` of 1) with so many rows."""


@dataclass(frozen=True)
class FreeViewpoint(Viewpoint):
    """A pinhole camera with square pixels: ``fov`` is vertical (radians), ``aspect`` width over height."""

    cam_to_world: Float[NDArray, "4 4"]
    fov: float
    aspect: float

    @property
    def key(self) -> Hashable:
        """Equal for viewpoints that see the same."""
        return (tuple(np.round(self.cam_to_world, 6).flatten().tolist()), round(self.fov, 6), round(self.aspect, 4))

    def cameras(self, rows: int) -> Cameras:
        """Return the camera (axis ``view`` of 1) with square pixels and so many rows."""
        columns = max(1, round(rows * min(max(self.aspect, 0.1), 10.0)))
        focal = 0.5 * rows / math.tan(0.5 * self.fov)
        intrinsics = torch.tensor([[focal, 0, columns / 2], [0, focal, rows / 2], [0, 0, 1.0]])
        pose = torch.from_numpy(np.asarray(self.cam_to_world, dtype=np.float32))
        return Cameras(intrinsics[None], pose[None], rows, columns)


@dataclass(frozen=True)
class RecordedViewpoint(Viewpoint):
    """A recorded camera (axis ``view`` of 1) and its number."""

    recorded: Cameras
    view: int

    @property
    def key(self) -> Hashable:
        """Equal for viewpoints that see the same."""
        return self.view

    @property
    def aspect(self) -> float:
        """Width over height."""
        return self.recorded.width / self.recorded.height

    def cameras(self, rows: int) -> Cameras:
        """Return the camera (axis ``view`` of 1), enlarged or reduced to so many rows."""
        return resized(self.recorded, rows, max(1, round(rows * self.aspect)))
