"""Frames of one recorded trajectory, read when they are needed or decoded once and kept in memory."""

import functools
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8

from vpd_lightning.data.driven import read_driven
from vpd_lightning.data.driven_motion import DrivenMotion
from vpd_lightning.data.reader import ReaderCache, TrajectoryReader

MAX_OPEN_FILES = 256  # the paper's largest training split; a process may usually open 1,024


class TrajectoryFrames:
    """The images and cameras of one trajectory file.

    Nothing stays open in here: files are opened through a ``ReaderCache`` of the process at hand, so that the object
    can be sent to loader workers. With ``use_cache`` each view is decoded whole at its first use and kept: uint8
    colours and float32 depths.
    """

    def __init__(self, path: Path, use_cache: bool) -> None:
        self.path = path
        self.use_cache = use_cache
        with TrajectoryReader(path) as reader:
            self.num_frames: int = reader.num_frames
            self.num_views: int = reader.num_views
            self.height: int = reader.height
            self.width: int = reader.width
            views = range(reader.num_views)
            # Small (a few hundred bytes a view), and asked for at every step.
            self._intrinsics, self._cam_to_world = reader.cameras(range(reader.num_frames), views)
        self._rgb: dict[int, np.ndarray] = {}
        self._depth: dict[int, np.ndarray] = {}

    def rgb(self, times: Sequence[int], views: Sequence[int]) -> UInt8[np.ndarray, "time view height width 3"]:
        """Return the colours of the given frames and views."""
        if not self.use_cache:
            return _reader(self.path).rgb(times, views)
        for view in views:
            if view not in self._rgb:
                self._rgb[view] = _reader(self.path).rgb(range(self.num_frames), [view])[:, 0]
        return np.stack([self._rgb[view][list(times)] for view in views], axis=1)

    def depth(self, times: Sequence[int], views: Sequence[int]) -> Float32[np.ndarray, "time view height width"]:
        """Return the z-depths in metres of the given frames and views; 0 or non-finite where nothing was measured."""
        if not self.use_cache:
            return _reader(self.path).depth(times, views)
        for view in views:
            if view not in self._depth:
                self._depth[view] = _reader(self.path).depth(range(self.num_frames), [view])[:, 0]
        return np.stack([self._depth[view][list(times)] for view in views], axis=1)

    def cameras(
        self, times: Sequence[int], views: Sequence[int]
    ) -> tuple[Float[np.ndarray, "time view 3 3"], Float[np.ndarray, "time view 4 4"]]:
        """Return (intrinsics in pixels, cam_to_world in metres) in float64."""
        block = np.ix_(list(times), list(views))
        return self._intrinsics[block], self._cam_to_world[block]

    def driven(self, times: Sequence[int]) -> DrivenMotion | None:
        """Return the given motion at the given frames; None where the recording has none."""
        motion = self._driven
        return None if motion is None else motion.at(times)

    @functools.cached_property
    def _driven(self) -> DrivenMotion | None:
        return read_driven(self.path)

    @property
    def is_static(self) -> bool:
        """Whether no camera moves or zooms during the trajectory."""
        return bool(
            (self._intrinsics == self._intrinsics[:1]).all() and (self._cam_to_world == self._cam_to_world[:1]).all()
        )


@functools.lru_cache(maxsize=1)
def _readers(process: int) -> ReaderCache:
    """Return the open files of one process: a forked worker must not use the handles of its parent."""
    return ReaderCache(MAX_OPEN_FILES)


def _reader(path: Path) -> TrajectoryReader:
    return _readers(os.getpid()).get(path)
