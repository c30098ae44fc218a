"""Workspace, near and far of a recording that does not say: estimated from its unprojected points."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.image_geometry import ImageGeometry
from data_gen.importers.settings import ImportSettings
from data_gen.importers.world_frame import WorldFrame
from vpd_lightning.errors import DataError

Array = NDArray[np.float64]

_MAX_RECORDINGS = 12
_FRAMES_EACH = 3
_POINTS_PER_IMAGE = 4000
_OUTLIERS = 0.01  # share of the points left out on each side of each axis: stray measurements, far corners
_MARGIN = 0.05  # of each side, added on both sides
_ROOM = 0.5  # of the longer horizontal side of what stands on the ground, on each side of it
_LEAST_ROOM = 0.15  # of the median distance
_BAND = 0.01  # of the median distance: how far points of a level ground may lie above or below it
_GROUND = 0.2  # share of the points that a ground has at least
_STANDING = 0.01  # share of the points that must stand above it, for it to be cut off around them
_STRAY = 0.001  # share of the points in the workspace that may lie before near


@dataclass(frozen=True)
class SceneBounds:
    """The box in which things happen (m, world), and the distances along rays between which it lies (m)."""

    near: float
    far: float
    workspace_min: tuple[float, float, float]
    workspace_max: tuple[float, float, float]
    estimated: tuple[str, ...]  # names of the settings that were not given
    ground: float | None = None  # m: height of a level ground whose far end was left out

    def __str__(self) -> str:
        lower, upper = (",".join(f"{x:g}" for x in corner) for corner in (self.workspace_min, self.workspace_max))
        return f"near={self.near:g} far={self.far:g} workspace_min=[{lower}] workspace_max=[{upper}]"


@dataclass(frozen=True)
class SampledPoints:
    """Some of the measured points (point, 3), and how far from its camera each is (point,), before any shift."""

    positions: Array
    distances: Array


def sample_points(geometries: Sequence[ImageGeometry], frame: WorldFrame, every: int) -> SampledPoints:
    """Unproject pixels of a few frames of a few recordings, chosen evenly.

    Raises:
        DataError: not one pixel has a depth.
    """
    positions, distances = [], []
    for geometry in geometries[:: max(1, math.ceil(len(geometries) / _MAX_RECORDINGS))]:
        recording = geometry.recording
        intrinsics, poses = geometry.intrinsics(), frame.poses(recording.cam_to_world)
        for time in sorted({*range(0, recording.num_frames, every)[:: _step(recording.num_frames, every)]}):
            for view in range(recording.num_views):
                matrix = intrinsics[view] if intrinsics.ndim == 3 else intrinsics[time, view]
                pose = poses[view] if poses.ndim == 3 else poses[time, view]
                seen = _unproject(frame.depth(geometry.depth(time, view)), matrix)
                positions.append(seen @ pose[:3, :3].T + pose[:3, 3])
                distances.append(np.linalg.norm(seen, axis=-1))
    if not sum(map(len, positions)):
        raise DataError(
            "Not one of the sampled pixels has a depth.\n"
            "Are the depth images empty, or named in another place? (0 means no measurement.)"
        )
    return SampledPoints(np.concatenate(positions), np.concatenate(distances))


def scene_bounds(points: SampledPoints, shift: Array, settings: ImportSettings) -> SceneBounds:
    """Return the given bounds, and estimates for those that are not given.

    The workspace holds all but 1 % of the points on each side of each axis, and 5 % more room; a level ground counts
    only around what stands on it. Near and far hold what is in it, 10 % wider.

    Raises:
        DataError: nothing lies in the given workspace, or the given and the estimated values contradict each other.
    """
    positions = points.positions + shift
    lower, upper = np.quantile(positions, [_OUTLIERS, 1 - _OUTLIERS], axis=0)
    lower, upper, ground = _without_far_ground(positions, lower, upper, float(np.median(points.distances)))
    sides = np.maximum(upper - lower, 0.02 * max((upper - lower).max(), 0.05))  # a mere plane needs some height
    middle = (lower + upper) / 2
    step = 10.0 ** math.floor(math.log10(sides.max())) / 100
    reach = sides * (0.5 + _MARGIN)
    estimate_min = [_rounded(x, step, math.floor) for x in middle - reach]
    estimate_max = [_rounded(x, step, math.ceil) for x in middle + reach]
    workspace_min = settings.workspace_min or estimate_min
    workspace_max = settings.workspace_max or estimate_max
    found = f"The points reach from {_text(estimate_min)} to {_text(estimate_max)} m."
    if not all(a < b for a, b in zip(workspace_min, workspace_max, strict=True)):
        raise DataError(f"The workspace {_text(workspace_min)} to {_text(workspace_max)} is empty.\n{found} Give both.")
    inside = ((positions >= workspace_min) & (positions <= workspace_max)).all(axis=-1)
    if not inside.any():
        raise DataError(
            f"No measured point lies in the workspace {_text(workspace_min)} to {_text(workspace_max)}.\n{found}\n"
            "If they should, a convention of the source is wrong: import it without near, far and workspace_*, and\n"
            "vpd-data validate names which."
        )
    distances = points.distances[inside]
    near = (
        settings.near if settings.near is not None else _digits(0.9 * float(np.quantile(distances, _STRAY)), math.floor)
    )
    far = settings.far if settings.far is not None else _digits(1.1 * float(distances.max()), math.ceil)
    if not near < far:
        raise DataError(f"near={near:g} and far={far:g} do not fit; the points are at most {distances.max():g} m away.")
    names = ("near", "far", "workspace_min", "workspace_max")
    return SceneBounds(
        near,
        far,
        (workspace_min[0], workspace_min[1], workspace_min[2]),
        (workspace_max[0], workspace_max[1], workspace_max[2]),
        tuple(name for name in names if getattr(settings, name) is None),
        None if settings.workspace_min and settings.workspace_max else ground,
    )


def _without_far_ground(
    positions: Array, lower: Array, upper: Array, distance: float
) -> tuple[Array, Array, float | None]:
    """Cut the box (3,), (3,) to what stands on a level ground, with room around it; return the ground's height, too.

    The box stays as it is, and the height is None, where there is no such ground or nothing stands on it.
    """
    band = _BAND * distance
    levels = np.round(positions[:, 2] / band)
    values, counts = np.unique(levels, return_counts=True)
    level = float(np.median(positions[levels == values[counts.argmax()], 2]))
    above = positions[:, 2] - level
    standing = positions[above > 2 * band]
    if (np.abs(above) <= band).mean() < _GROUND or len(standing) < _STANDING * len(positions):
        return lower, upper, None
    low, high = np.quantile(standing[:, :2], [_OUTLIERS, 1 - _OUTLIERS], axis=0)
    room = max(_ROOM * float((high - low).max()), _LEAST_ROOM * distance)
    cut_lower, cut_upper = lower.copy(), upper.copy()
    cut_lower[:2], cut_upper[:2] = np.maximum(lower[:2], low - room), np.minimum(upper[:2], high + room)
    cut_upper[2] = max(upper[2], float(np.quantile(standing[:, 2], 1 - _OUTLIERS)))  # few points, but all of a pole
    if np.array_equal(cut_lower, lower) and np.array_equal(cut_upper, upper):
        return lower, upper, None
    return cut_lower, cut_upper, level


def _step(num_frames: int, every: int) -> int:
    return max(1, (len(range(0, num_frames, every)) - 1) // (_FRAMES_EACH - 1))


def _unproject(depth: NDArray[np.float32], intrinsics: Array) -> Array:
    rows, columns = np.nonzero(depth)
    thin = slice(None, None, max(1, len(rows) // _POINTS_PER_IMAGE))
    rows, columns = rows[thin], columns[thin]
    z = depth[rows, columns].astype(np.float64)
    y = (rows + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1]
    x = (columns + 0.5 - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
    return np.stack([x * z, y * z, z], axis=-1)


def _rounded(value: float, step: float, rounding: Callable[[float], int]) -> float:
    return round(rounding(value / step) * step, 12)


def _digits(value: float, rounding: Callable[[float], int]) -> float:
    """Round to two significant digits, so that a person can type the number."""
    return _rounded(value, 10.0 ** (math.floor(math.log10(value)) - 1), rounding)


def _text(corner: Sequence[float]) -> str:
    return "[" + ", ".join(f"{x:g}" for x in corner) + "]"
