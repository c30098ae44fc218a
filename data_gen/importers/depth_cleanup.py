"""Cleaning measured depth: pixels in the air between two surfaces, noise, and holes that an earlier frame can fill.

All of it is off unless asked for. Depth is z in metres, 0 where nothing was measured; no frame behind the one that is
cleaned is used, so that a model trained on the result can be given a live camera's frames cleaned in the same way.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from vpd_lightning.geometry.noisy_planes import relative_noise

Depth = NDArray[np.float32]

_STEEPEST = np.tan(np.radians(80.0))
"""A surface seen at more than 80 degrees is not measured reliably; its pixels go with those in the air."""

_LINES = ((0, 1), (1, 0))  # rows and columns: along diagonals, the tips of true outlines lie between near and far, too
_DIAGONALS = ((1, 1), (1, -1))

_NOISE_KEPT_APART = 3.0
"""Standard deviations by which two pixels must differ to be smoothed apart."""

_NOISE_OF_A_JUMP = 4.0
"""Standard deviations by which neighbours on one surface hardly ever differ."""

_LEAST_NOISE = 1e-4
"""Share of depth below which noise is taken for rounding; keeps the filter from dividing by nothing."""

_SAME_PLACE = 0.02
"""Share of depth by which a fixed camera's pixel may change where nothing moved."""

_SURROUNDINGS = 5
"""Side in pixels of the square around a hole in which nothing may have moved."""


def without_flying_pixels(depth: Depth, focal_length: float, jump: float) -> Depth:
    """Remove pixels that lie in the air between a nearer and a farther surface, and pixels by themselves.

    Args:
        depth: (height, width) metres.
        focal_length: in pixels; surfaces less steep than 80 degrees to the line of sight are kept.
        jump: share of depth by which a pixel must differ from both opposite neighbours, to be removed; more where
            that is within the noise that the image shows.
    """
    noise = float(relative_noise(depth[None].astype(np.float64), depth[None] > 0)[0])
    step = max(jump, _STEEPEST / focal_length, _NOISE_OF_A_JUMP * noise) * depth
    padded = np.pad(depth, 1)
    height, width = depth.shape

    def at(row: int, column: int) -> Depth:
        return padded[1 + row : 1 + row + height, 1 + column : 1 + column + width]

    is_flying = np.zeros(depth.shape, bool)
    is_alone = np.ones(depth.shape, bool)
    for row, column in (*_LINES, *_DIAGONALS):
        one, other = at(row, column), at(-row, -column)
        if (row, column) in _LINES:
            near, far = np.minimum(one, other), np.maximum(one, other)
            is_flying |= (near > 0) & (depth - near > step) & (far - depth > step)
        for neighbour in (one, other):
            is_alone &= (neighbour <= 0) | (np.abs(neighbour - depth) > step)
    return np.where(is_flying | is_alone, np.float32(0), depth)


def smoothed(depth: Depth, radius: float) -> Depth:
    """Smooth surfaces, not edges: OpenCV's bilateral filter of inverse depth.

    The noise of stereo and of structured light is about the same everywhere in inverse depth, and planes are linear in
    it. It is estimated from the image itself; pixels that differ by more than three standard deviations are not mixed.
    Holes stay holes.

    Args:
        depth: (height, width) metres.
        radius: standard deviation in pixels of the weights of neighbours.
    """
    is_measured = depth > 0
    if not is_measured.any():
        return depth
    inverse = np.where(is_measured, 1 / np.where(is_measured, depth, 1), 0).astype(np.float32)
    noise = max(float(relative_noise(depth[None].astype(np.float64), is_measured[None])[0]), _LEAST_NOISE)
    spread = _NOISE_KEPT_APART * noise * float(np.median(inverse[is_measured]))
    mixed = cv2.bilateralFilter(inverse, d=0, sigmaColor=spread, sigmaSpace=radius)
    # Next to a hole (inverse depth 0) weights of far surfaces need not vanish; such pixels keep their value.
    is_sound = is_measured & (np.abs(mixed - inverse) <= 3 * spread)
    return np.where(is_sound, 1 / np.where(is_sound, mixed, 1), depth).astype(np.float32)


class HoleFiller:
    """Fills holes in the depth of a camera that stands still by what it measured there in earlier frames.

    A hole is filled by the last of at most ``max_age`` earlier frames, where that pixel showed the same depth before
    it, too, and nothing around the hole (5 x 5 pixels) differs from what was there then: a hole in something that
    moves, or beside it, stays a hole. One instance per camera; frames come in order of time.
    """

    def __init__(self, max_age: int) -> None:
        self.max_age = max_age
        self._last: Depth | None = None
        self._age: NDArray[np.int64] | None = None
        self._is_steady: NDArray[np.bool_] | None = None

    def __call__(self, depth: Depth) -> Depth:
        """Return the next frame (height, width) with holes filled."""
        is_measured = depth > 0
        if self._last is None or self._age is None or self._is_steady is None:
            self._last, self._age = depth.copy(), np.where(is_measured, 0, self.max_age + 1)
            self._is_steady = np.zeros(depth.shape, bool)
            return depth
        is_known = self._last > 0
        is_same = np.abs(depth - self._last) <= _SAME_PLACE * self._last
        has_changed = is_measured & is_known & ~is_same
        around = np.ones((_SURROUNDINGS, _SURROUNDINGS), np.uint8)
        near_change = cv2.dilate(has_changed.astype(np.uint8), around).astype(bool)
        # A hole is taken as a whole: in its middle nothing is measured that could have changed.
        _, holes = cv2.connectedComponents((~is_measured).astype(np.uint8), connectivity=8)
        near_change |= np.isin(holes, np.unique(holes[near_change & ~is_measured])) & ~is_measured
        age = self._age + 1
        is_filled = ~is_measured & self._is_steady & (age <= self.max_age) & ~near_change
        filled = np.where(is_filled, self._last, depth)
        self._is_steady = np.where(is_measured, is_known & is_same, self._is_steady & ~near_change)
        self._last = np.where(is_measured, depth, self._last)
        self._age = np.where(is_measured, 0, age)
        return filled
