"""Whether the colours of two views agree where surfaces do not say: a slide along a table, a turn about its normal.

The colours of one view's points are compared with those that the other view has where the points appear in it, up to
a gain and an offset for each channel, and the points are moved until they agree best: direct image alignment (Lucas and
Kanade 1981), coarse to fine, along those motions alone that surfaces do not determine (as in coloured ICP, Park et al.
2017, with the two kinds of evidence one after the other).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from data_gen.inspection.posed_depth import Array, PosedDepth

_BLURS = (5.0, 3.0, 1.5)  # pixels: a slide is found from about twice as far away
_NUM_ROUNDS = 8  # linear steps at each of them
_ROBUST = 1.5  # standard deviations from which on a point counts less
_MIN_POINTS = 200
_MAX_CONDITION = 1e14  # of the normal equations: beyond it some motion, gain or offset changes nothing
_ROUNDING = 0.25  # of colours in steps of one
_MUST_EXPLAIN = 0.75  # of the mean absolute difference may be left: highlights, which move with the camera, leave 0.8


@dataclass(frozen=True)
class ColoredView:
    """Points of one image and where another image of the same moment may show them."""

    points: Float[NDArray[np.float64], "point 3"]  # world, metres
    pixels: NDArray[np.int64]  # (point, 2), row and column in the image that they come from
    rgb: UInt8[NDArray[np.uint8], "height width 3"]
    other: PosedDepth
    other_rgb: UInt8[NDArray[np.uint8], "height width 3"]

    @property
    def pixel_width(self) -> float:
        """Metres that a pixel of the other image is wide where the points are."""
        depth = (self.points - self.other.cam_to_world[:3, 3]) @ self.other.cam_to_world[:3, 2]
        return float(np.median(depth)) / float(self.other.intrinsics[0, 0])


@dataclass(frozen=True)
class Slide:
    """How points must be moved for their colours to agree: a shift and a turn (times the radius), metres.

    ``error`` is the standard error along the axis that is known least.
    """

    motion: Float[NDArray[np.float64], "6"]
    error: float


def slide(parts: Sequence[ColoredView], center: Array, radius: float, axes: Array) -> Slide | None:
    """Estimate motions of the points along axes; None where colours cannot tell.

    Args:
        parts: at several moments, for one motion of all.
        center: world, metres, about which is turned.
        radius: metres, by which turns are measured.
        axes: (6, axis), each a shift and a turn (times ``radius``) of unit length together.
    """
    parts = [part for part in parts if len(part.points)]
    if sum(len(part.points) for part in parts) < _MIN_POINTS or not axes.shape[1]:
        return None
    # Farther than images are blurred, colours that look alike are others.
    reach = 2 * _BLURS[0] * float(np.median([part.pixel_width for part in parts]))
    lengths, found = np.zeros(axes.shape[1]), None
    for blur in _BLURS:
        blurred = [_Blurred(part, blur) for part in parts]
        for _ in range(_NUM_ROUNDS):
            found = _step([part.seen(center, radius, axes, lengths) for part in blurred], axes.shape[1])
            if found is None:
                return None
            lengths = lengths + found.step
            if np.linalg.norm(lengths) > reach:
                return None
            if np.abs(found.step).max() < 0.1 * found.errors.max():
                break
    as_stored = _step([part.seen(center, radius, axes, 0 * lengths) for part in blurred], axes.shape[1])
    if found is None or as_stored is None:
        return None
    if found.difference > _MUST_EXPLAIN * as_stored.difference:
        lengths = 0 * lengths  # no motion explains the differences: where the points are is as good as any
    # Blurred pixels err together: so many of them are one.
    return Slide(axes @ lengths, float(found.errors.max()) * np.sqrt(4 * np.pi) * _BLURS[-1])


class _Blurred:
    """A pair of images at one resolution."""

    def __init__(self, part: ColoredView, blur: float) -> None:
        self.points, self.other = part.points, part.other
        rows, columns = part.pixels.T
        own, images = (_channels(rgb, blur) for rgb in (part.rgb, part.other_rgb))
        self.here = np.stack([channel[rows, columns] for channel in own], axis=1)
        self.images = [(image, *np.gradient(image)) for image in images]

    def seen(self, center: Array, radius: float, axes: Array, lengths: Array) -> tuple[Array, Array, Array]:
        """Return colours here and there (point channel), and the gradient of the latter along the axes."""
        motion, arms = axes @ lengths, self.points - center
        moved = self.points + motion[:3] + np.cross(motion[3:] / radius, arms)
        rotation, intrinsics = self.other.cam_to_world[:3, :3], self.other.intrinsics
        x, y, z = ((moved - self.other.cam_to_world[:3, 3]) @ rotation).T
        usable = z > 1e-6
        z = np.where(usable, z, 1.0)
        right = (intrinsics[0, 0] * x + intrinsics[0, 1] * y) / z  # of the principal point, pixels
        down = intrinsics[1, 1] * y / z
        column, row = right + intrinsics[0, 2] - 0.5, down + intrinsics[1, 2] - 0.5
        height, width = self.images[0][0].shape
        usable &= (column >= 1) & (column <= width - 2) & (row >= 1) & (row <= height - 2)
        turns = np.cross(axes[3:].T[None] / radius, arms[:, None]).transpose(0, 2, 1)
        steps = np.einsum("ji,pja->pia", rotation, axes[None, :3] + turns)  # in the camera
        to_column = intrinsics[0, 0] * steps[:, 0] + intrinsics[0, 1] * steps[:, 1] - right[:, None] * steps[:, 2]
        to_row = intrinsics[1, 1] * steps[:, 1] - down[:, None] * steps[:, 2]
        to_column, to_row = (part[usable] / z[usable, None] for part in (to_column, to_row))
        at = np.stack([row[usable], column[usable]])
        there, slopes = [], []
        for image, downward, rightward in self.images:
            there.append(map_coordinates(image, at, order=1))
            slope = map_coordinates(rightward, at, order=1)[:, None] * to_column
            slopes.append(slope + map_coordinates(downward, at, order=1)[:, None] * to_row)
        return self.here[usable], np.stack(there, axis=1), np.stack(slopes, axis=1)


def _channels(rgb: UInt8[NDArray[np.uint8], "height width 3"], blur: float) -> list[Array]:
    return [gaussian_filter(rgb[..., channel].astype(np.float64), blur) for channel in range(3)]


class _Found(NamedTuple):
    """The next step along the axes, its standard errors, and the mean absolute difference of colours before it."""

    step: Array
    errors: Array
    difference: float


def _step(seen: Sequence[tuple[Array, Array, Array]], num_axes: int) -> _Found | None:
    """Fit the step together with gain and offset of each channel; None where colours say nothing of it."""
    here, there, slopes = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    if len(here) < _MIN_POINTS:
        return None
    columns = np.zeros((*here.shape, num_axes + 6))
    columns[..., :num_axes] = slopes
    for channel in range(3):
        columns[:, channel, num_axes + channel] = -here[:, channel]
        columns[:, channel, num_axes + 3 + channel] = -1.0
    design, values = columns.reshape(-1, num_axes + 6), -there.reshape(-1)
    weights = np.ones(len(values))
    for _ in range(3):
        weighted = design * weights[:, None]
        products = weighted.T @ design
        if not np.linalg.cond(products) < _MAX_CONDITION:
            return None
        solution = np.linalg.solve(products, weighted.T @ values)
        left = np.abs(design @ solution - values)
        scatter = max(1.4826 * float(np.median(left)), _ROUNDING)
        weights = np.minimum(1.0, _ROBUST * scatter / np.maximum(left, 1e-9))
    errors = scatter * np.sqrt(np.diag(np.linalg.inv(products))[:num_axes])
    before = values - design[:, num_axes:] @ solution[num_axes:]
    return _Found(solution[:num_axes], errors, float(np.abs(before).mean()))
