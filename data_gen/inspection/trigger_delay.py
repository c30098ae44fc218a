"""How much later than the others a camera takes its pictures, estimated from depth of what moves.

A point of one view is looked up in the depth image of another. Where the first camera is later by ``delay``, the
surface has gone on: the point's depth in the second view differs from the image's by ``delay`` times the image's change
per frame at that pixel. So the slope of differences against changes is the delay, whatever the shape of the body; a
body's thickness or an offset between the cameras is the constant beside it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from data_gen.inspection.free_space import depth_noise
from data_gen.inspection.posed_depth import Array, PosedDepth, angle_between, rays
from vpd_lightning.data.reader import MAX_FRAMES, TrajectoryReader

MAX_DELAY = 0.2
"""Share of the time between frames by which a view may be late."""

_SURE = 4.0  # standard errors beyond that share
_MIN_POINTS = 100
_MIN_MOMENTS = 3  # frames, of one or several files: points of one moment err together
_MAX_MOMENTS = 32  # per file, evenly chosen
_MAX_VIEWS = 8  # evenly chosen: pairs grow with the square
_MAX_ANGLE = 130.0  # degrees between two cameras: beyond, they see opposite sides
_MAX_PIXELS = 128  # along a side; every second, third ... pixel of larger pictures
_NOISES, _CLOSER = 6.0, 0.02  # standard deviations of noise, or share of depth, that a body is in front of scenery
_BEND = 0.01  # of the depth: more curved in time is an edge that passes
_REACH = 0.05  # of the depth: farther apart are other surfaces
_NUM_ROUNDS, _INLIER = 20, 2.0
_FLOOR = 0.01  # frames: no slope is known better


@dataclass(frozen=True)
class TriggerDelay:
    """How much later ``view`` is than the middle one of all, its standard error, and the time between frames (s).

    ``others`` are the views that it was compared with, some of them by way of a third one. Of two, each is compared
    with the other.
    """

    view: int
    others: tuple[int, ...]
    delay: float
    error: float
    frame_time: float

    @property
    def is_known(self) -> bool:
        """Whether a fifth of a frame would show."""
        return _SURE * self.error < MAX_DELAY * self.frame_time

    @property
    def is_certain(self) -> bool:
        """Whether it is surely more than a fifth of a frame."""
        return abs(self.delay) > MAX_DELAY * self.frame_time + _SURE * self.error


@dataclass(frozen=True)
class _Changes:
    """Points of one view in another: differences of depth, and its change per frame (point,), metres; their moments."""

    differences: Array
    changes: Array
    moments: NDArray[np.int64]


def trigger_delays(paths: Sequence[Path]) -> list[TriggerDelay]:
    """Compare all views of recordings of the same cameras; views that nothing relates to the others are left out.

    Told are cameras that stand still and see something move, in three frames or more.
    """
    collected: dict[tuple[int, int], list[_Changes]] = {}
    frame_time = 0.0
    for number, path in enumerate(paths):
        with TrajectoryReader(path) as reader:
            if not reader.is_static_cameras or reader.num_views < 2 or reader.num_frames < 3:
                continue
            frame_time = reader.frame_time
            for pair, changes in _changes(reader, number).items():
                collected.setdefault(pair, []).append(changes)
    slopes = {}
    for pair, parts in collected.items():
        slope = _slope(_joined(parts))
        if slope is not None:
            slopes[pair] = slope
    return _delays(slopes, frame_time) if slopes else []


def _changes(reader: TrajectoryReader, number: int) -> dict[tuple[int, int], _Changes]:
    """Collect the moving points of every ordered pair of views of one recording."""
    count = min(reader.num_frames - 2, _MAX_MOMENTS)
    middles = np.unique(np.linspace(1, reader.num_frames - 2, count).round().astype(int))
    frames = np.unique(np.concatenate([middles - 1, middles, middles + 1])).tolist()
    views = np.unique(np.linspace(0, reader.num_views - 1, _MAX_VIEWS).round().astype(int)).tolist()
    step = -(-max(reader.height, reader.width) // _MAX_PIXELS)
    depth = np.stack([reader.depth([time], views)[0, :, ::step, ::step] for time in frames])
    intrinsics, poses = (part[0] for part in reader.cameras([0], views))
    intrinsics = np.stack([_every(one, step) for one in intrinsics])
    images = [[PosedDepth(*parts) for parts in zip(one, intrinsics, poses, strict=True)] for one in depth]
    noise = float(np.median([depth_noise(image) for image in images[0]]))
    nearer = np.stack([_in_front(depth[:, view], max(_CLOSER, _NOISES * noise)) for view in range(len(views))], axis=1)
    found = {}
    for one, other in permutations(range(len(views)), 2):
        if angle_between(poses[one, :3, :3], poses[other, :3, :3]) > _MAX_ANGLE:
            continue
        parts = []
        for middle in middles.tolist():
            index = frames.index(middle)
            window = slice(index - 1, index + 2)
            differences, changes = _compare(
                images[index][one],
                nearer[index, one],
                images[index][other],
                depth[window, other],
                nearer[window, other],
            )
            parts.append(_Changes(differences, changes, np.full(len(changes), number * MAX_FRAMES + middle)))
        found[views[one], views[other]] = _joined(parts)
    return found


def _every(intrinsics: Array, step: int) -> Array:
    """Intrinsics of every ``step``-th pixel, from the first one on; pixel centres at +0.5."""
    scaled = intrinsics.astype(np.float64)
    scaled[:2] /= step
    scaled[:2, 2] += 0.5 - 0.5 / step
    return scaled


def _in_front(depth: NDArray[np.float32], share: float) -> NDArray[np.bool_]:
    """Which pixels (frame, height, width) see something nearer than in most frames, by a share of the depth."""
    usual = _median_of_measured(depth)
    return (depth > 0) & np.isfinite(usual) & (usual - depth > share * depth)


def _median_of_measured(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Median over frames of the measured depths of a pixel; infinite where none is."""
    ordered = np.sort(np.where(depth > 0, depth, np.inf), axis=0)
    middle = np.maximum((np.isfinite(ordered).sum(axis=0) - 1) // 2, 0)
    return np.take_along_axis(ordered, middle[None], axis=0)[0]


def _compare(
    here: PosedDepth,
    is_moving: NDArray[np.bool_],
    other: PosedDepth,
    window: NDArray[np.float32],
    is_moving_there: NDArray[np.bool_],
) -> tuple[Array, Array]:
    """Look up the moving points of one view in three frames of another: differences of depth, and change per frame."""
    rows, columns = np.nonzero(is_moving)
    points = rays(here.intrinsics, columns, rows) * here.depth[rows, columns].astype(np.float64)[:, None]
    points = points @ here.cam_to_world[:3, :3].T + here.cam_to_world[:3, 3]
    seen = (points - other.cam_to_world[:3, 3]) @ other.cam_to_world[:3, :3]
    seen = seen[seen[:, 2] > 1e-9]
    pixels = np.floor((seen @ other.intrinsics.T)[:, :2] / seen[:, 2:])
    height, width = other.depth.shape
    is_inside = (pixels >= 0).all(axis=1) & (pixels < [width, height]).all(axis=1)
    column, row = pixels[is_inside].astype(np.int64).T
    distance = seen[is_inside, 2]
    before, now, after = window[:, row, column].astype(np.float64)
    kept = is_moving_there[:, row, column].all(axis=0)
    kept &= (np.abs(after - 2 * now + before) < _BEND * distance) & (np.abs(distance - now) < _REACH * distance)
    return (distance - now)[kept], ((after - before) / 2)[kept]


def _joined(parts: Sequence[_Changes]) -> _Changes:
    return _Changes(*(np.concatenate([getattr(part, name) for part in parts]) for name in _Changes.__annotations__))


def _slope(points: _Changes) -> tuple[float, float] | None:
    """Return the slope (frames) of differences against changes and its standard error; None where too little moves.

    Outliers are other surfaces: robust weights (Geman and McClure). Points of one moment err together, as they lie on
    one body: the error counts moments, not points.
    """
    moments, belongs = np.unique(points.moments, return_inverse=True)
    if len(points.changes) < _MIN_POINTS or len(moments) < _MIN_MOMENTS:
        return None
    design = np.stack([points.changes, np.ones_like(points.changes)], axis=1)
    weights = np.ones(len(design))
    for _ in range(_NUM_ROUNDS):
        square = design.T @ (weights[:, None] * design)
        if np.linalg.cond(square) > 1e12:
            return None
        solution = np.linalg.solve(square, design.T @ (weights * points.differences))
        left = points.differences - design @ solution
        scatter = 1.4826 * float(np.median(np.abs(left))) + 1e-12
        weights = 1 / (1 + (left / (_INLIER * scatter)) ** 2) ** 2
    pulls = np.zeros((len(moments), 2))
    np.add.at(pulls, belongs, (weights * left)[:, None] * design)
    inverse = np.linalg.inv(square)
    spread = inverse @ (pulls.T @ pulls) @ inverse * len(moments) / (len(moments) - 1)
    return float(solution[0]), float(np.sqrt(spread[0, 0]))


def _delays(slopes: dict[tuple[int, int], tuple[float, float]], frame_time: float) -> list[TriggerDelay]:
    """Return each view's delay: slopes are differences of two, weighted by what is known of each."""
    views = sorted({view for pair in slopes for view in pair})
    place = {view: index for index, view in enumerate(views)}
    design = np.zeros((len(slopes), len(views)))
    for row, (one, other) in enumerate(slopes):
        design[row, place[one]], design[row, place[other]] = 1.0, -1.0
    values, errors = np.array(list(slopes.values())).reshape(-1, 2).T
    weights = 1 / (errors**2 + _FLOOR**2)
    inverse = np.linalg.pinv(design.T @ (weights[:, None] * design))
    delays = inverse @ (design.T @ (weights * values))
    _, groups = connected_components(design.T @ design)
    misfit = float((weights * (values - design @ delays) ** 2).sum()) / max(len(values) - len(views) + 1, 1)
    found = []
    for view in views:
        group = np.flatnonzero(groups == groups[place[view]]).tolist()
        others = [index for index in group if index != place[view]]
        # The middle one of all views, or the other one of two, as a linear form, for its error.
        ordered = sorted(group if len(group) > 2 else others, key=lambda index: delays[index])
        middle = np.zeros(len(views))
        for index in {ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]}:
            middle[index] = 1.0
        form = np.eye(len(views))[place[view]] - middle / middle.sum()
        error = np.sqrt(form @ inverse @ form * max(1.0, misfit))
        found.append(
            TriggerDelay(
                view,
                tuple(views[index] for index in others),
                float(form @ delays) * frame_time,
                float(error) * frame_time,
                frame_time,
            )
        )
    return found
