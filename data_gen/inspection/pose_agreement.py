"""Whether cameras of one moment stand where their poses say, estimated from surfaces that two of them see.

Noise hides a wrong pose from single points, and not from all of them together: the points of one view are moved
rigidly onto the surfaces that another view sees there (point to plane, Chen and Medioni 1992, one linear step), and how
far they are moved is compared with how surely it is known. What the surfaces do not determine, as sliding along a
table, is told by colours (``color_agreement``); what neither determines counts as right.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_gen.inspection.camera_conventions import STORED, CameraConvention
from data_gen.inspection.color_agreement import ColoredView, slide
from data_gen.inspection.posed_depth import Array, PosedDepth, choose_pairs, rays, read_posed_depth
from data_gen.inspection.smooth_surface import SmoothSurface, smooth_surface
from vpd_lightning.data.reader import TrajectoryReader

MAX_MISPLACED = 0.005
"""Share of the depth by which a pose may move surfaces: 1 cm at 2 m. Good calibrations leave a quarter of it."""

_SURE = 4.0  # standard errors beyond that share
_MIN_POINTS = 100
_MAX_TIMES = 5
_SPACING = 3  # pixels between points: nearer ones err alike
_REACH = 0.1  # of the depth: farther apart are other surfaces
_NUM_ROUNDS, _INLIER = 4, 3.0  # fits, and standard deviations within which points count
_KEPT = 0.015  # of the depth: so far off points always count, or a bare floor would outvote all that stands on it
_OPEN = 0.02  # share of the points that face a motion below which it is asked of colours
_CLEARLY_BETTER = 0.5  # share of the distances that a convention leaves which explains them, median over the pairs
_ROUNDING = 1e-4  # of the depth: what is nearer is together
_TIED = 0.8  # share of the worst view's median distance from which another one is as suspect
_MUTUAL = 0.5  # share of a slide by which those of either view to the other differ at most
_MOST_COLORED = 5000  # points of a moment
_TELLING = 20.0  # points that face a motion, or as many more that it passes at an angle; fewer say nothing of it


@dataclass(frozen=True)
class Misplacement:
    """The rigid motion that brings one view's surfaces onto another's: its surest part, a shift or a turn.

    ``distance`` is metres, of a turn at the mean distance from the points' centre; ``error`` is its standard error,
    ``depth`` the median depth of the points, all in metres. ``evidence`` says what lies apart: surfaces or colours.
    """

    views: tuple[int, int]
    distance: float
    error: float
    depth: float
    evidence: str = "surfaces"
    shift: tuple[float, ...] = ()  # of colours, metres in the world

    @property
    def is_certain(self) -> bool:
        """Whether it is surely more than a calibration leaves."""
        return self.excess > 0

    @property
    def excess(self) -> float:
        """Metres that it is surely more than a calibration leaves, negative where it is not."""
        return self.distance - MAX_MISPLACED * self.depth - _SURE * self.error


class SurfaceOffsets(NamedTuple):
    """Points of one view and how far they lie from the surfaces of another, along normals.

    Attributes:
        points: (point, 3), world, metres.
        normals: (point, 3), world.
        distances: (point,), metres along the normal to the other view's surface.
        depth: (point,), metres, of the point in its own view.
        pixels: (point, 2), row and column of the point in its own view.
    """

    points: Array
    normals: Array
    distances: Array
    depth: Array
    pixels: NDArray[np.int64]

    def every(self, stride: int) -> "SurfaceOffsets":
        """Return one of ``stride`` points."""
        some = slice(None, None, stride)
        return SurfaceOffsets(
            self.points[some], self.normals[some], self.distances[some], self.depth[some], self.pixels[some]
        )


def misplacements(
    reader: TrajectoryReader, max_pairs: int, convention: CameraConvention = STORED
) -> list[Misplacement]:
    """Compare views of one moment, pair by pair, under a convention; pairs that share too few surfaces are left out.

    Cameras that stand still are compared at several moments together: what moves shows its sides at different places.
    """
    middle = reader.num_frames // 2
    times = [middle]
    if reader.is_static_cameras:
        times = np.unique(np.linspace(0, reader.num_frames - 1, _MAX_TIMES).round().astype(int)).tolist()
    pairs = [(one[1], two[1]) for one, two in choose_pairs(reader, max_pairs, [middle]) if one[0] == two[0]]
    images = read_posed_depth(reader, [(time, view) for time in times for pair in pairs for view in pair])
    if convention != STORED:
        images = {key: convention.read(image) for key, image in images.items()}
    surfaces = {key: smooth_surface(image) for key, image in images.items()}
    found = []
    for first, second in pairs:
        parts = [
            surface_offsets(images[time, first], surfaces[time, first], images[time, second], surfaces[time, second])
            for time in times
        ]
        joined = SurfaceOffsets(*(np.concatenate(part) for part in zip(*parts, strict=True)))
        found += _misplacement((first, second), joined)
    if any(item.is_certain for item in found):
        return found
    # Surfaces are right as far as they tell; the rest is asked of colours, at the first and the middle moment.
    for first, second in pairs:
        parts, seen = [], []
        for time in times[:: max(1, len(times) // 2)][:2]:
            key, other = (time, first), (time, second)
            part = surface_offsets(images[key], surfaces[key], images[other], surfaces[other], spacing=1)
            part = part.every(1 + len(part.points) // _MOST_COLORED)
            rgb, other_rgb = (reader.rgb([time], [view])[0, 0] for view in (first, second))
            parts.append(part)
            seen.append(ColoredView(part.points, part.pixels, rgb, images[other], other_rgb))
        joined = SurfaceOffsets(*(np.concatenate(part) for part in zip(*parts, strict=True)))
        found += _slide((first, second), joined, seen)
    return [item for item in found if not item.shift or _is_mutual(item, found)]


def outlier_views(found: Sequence[Misplacement]) -> tuple[tuple[int, ...], Misplacement] | None:
    """Return the view whose pairs are farthest off, with its worst pair; None where no pair is certain.

    Both views of that pair where nothing tells which of them it is: two cameras alone, or no third that acquits one.
    A pair counts where it is certain either way around: from its first view's points, and from its second's. Colours
    count where two comparisons of that view say so.
    """
    either = {(*item.views, item.evidence): item for item in found}
    certain = [
        item for item in found if item.is_certain and either.get((*item.views[::-1], item.evidence), item).is_certain
    ]
    if not certain:
        return None
    evidence = certain[0].evidence  # of all: colours are asked where surfaces accuse nobody
    off = {
        view: [item for item in found if view in item.views and item.evidence == evidence]
        for pair in certain
        for view in pair.views
    }
    medians = {view: float(np.median([item.distance for item in items])) for view, items in off.items()}
    # One that stands wrong is apart from all that see the same; each of those may have been compared with it alone.
    partners = {view: len({frozenset(item.views) for item in certain if view in item.views}) for view in off}
    far = [view for view in off if medians[view] >= _TIED * max(medians.values())]
    worst = max(far, key=lambda view: (partners[view], medians[view]))
    if evidence == "colours" and sum(item.is_certain for item in off[worst]) < 2:
        return None
    pair = max((item for item in certain if worst in item.views), key=lambda item: item.distance)
    other = sum(pair.views) - worst
    is_open = other in far and partners[other] == partners[worst]
    return (tuple(sorted((worst, other))) if is_open else (worst,)), pair


def explanation(
    reader: TrajectoryReader, max_pairs: int, conventions: Iterable[CameraConvention], stored: Sequence[Misplacement]
) -> CameraConvention | None:
    """Return the convention under which cameras that surely stand apart stand together; None where there is none.

    What noise hides from single points, all of them together tell. A single camera that stands wrong is explained by no
    convention: its own pairs come nearer, and the others fall apart.

    Args:
        reader: of the recording.
        max_pairs: of views.
        conventions: that single points cannot tell from the stored one.
        stored: what ``misplacements`` found in the recording as it is.
    """
    before = {(*item.views, item.evidence): item.distance for item in stored}
    excess = [item.distance - _SURE * item.error - _ROUNDING * item.depth for item in stored]
    if not excess or np.median(excess) <= 0:
        return None
    left: dict[CameraConvention, float] = {}
    for convention in conventions:
        found = misplacements(reader, max_pairs, convention)
        shares = [
            item.distance / before[key] for item in found if before.get(key := (*item.views, item.evidence), 0.0) > 0
        ]
        if shares and outlier_views(found) is None:
            left[convention] = float(np.median(shares))
    best = min(left, key=left.__getitem__, default=None)
    return best if best is not None and left[best] <= _CLEARLY_BETTER else None


def _slide(views: tuple[int, int], offsets: SurfaceOffsets, seen: Sequence[ColoredView]) -> list[Misplacement]:
    """Return how far colours lie apart along what the surfaces leave open; empty where they cannot tell."""
    if len(offsets.points) < _MIN_POINTS:
        return []
    motions, center, radius = _motions(offsets)
    values, axes = np.linalg.eigh(motions.T @ motions)
    found = slide(seen, center, radius, axes[:, values <= _OPEN * len(motions)])
    if found is None:
        return []
    distance, depth = float(np.linalg.norm(found.motion)), float(np.median(offsets.depth))
    return [Misplacement(views, distance, found.error, depth, "colours", tuple(found.motion[:3].tolist()))]


def _is_mutual(item: Misplacement, found: Sequence[Misplacement]) -> bool:
    """Whether the second view's colours must be shifted the other way, or nobody asked for that."""
    back = [other for other in found if other.shift and other.views == item.views[::-1]]
    return all(np.linalg.norm(np.add(item.shift, other.shift)) <= _MUTUAL * item.distance for other in back)


def _motions(offsets: SurfaceOffsets) -> tuple[Array, Array, float]:
    """Return what a motion does to each distance (point 6), and the centre and mean radius that turns are about.

    Columns: translation, and rotation about the centre in units that move a point at the mean radius by as much.
    """
    center = offsets.points.mean(axis=0)
    arms = offsets.points - center
    radius = float(np.sqrt((arms**2).sum(axis=1).mean()))
    return np.concatenate([offsets.normals, np.cross(arms / radius, offsets.normals)], axis=1), center, radius


def _misplacement(views: tuple[int, int], offsets: SurfaceOffsets) -> list[Misplacement]:
    residuals, depth = offsets.distances, offsets.depth
    if len(residuals) < _MIN_POINTS:
        return []
    motions, _, _ = _motions(offsets)
    off = np.abs(residuals - np.median(residuals))
    inside = off <= np.maximum(_INLIER * 1.4826 * float(np.median(off)), _KEPT * depth)
    for _ in range(_NUM_ROUNDS):
        if inside.sum() < _MIN_POINTS:
            return []
        lengths, values, axes = _motion(motions[inside], residuals[inside])
        left = residuals - motions @ (axes @ lengths)
        scatter = 1.4826 * float(np.median(np.abs(left[inside])))
        inside = np.abs(left) <= np.maximum(_INLIER * scatter, _KEPT * depth)
    if not len(values):
        return []
    errors = scatter / np.sqrt(values)
    worst = int(np.argmax(np.abs(lengths) - _SURE * errors))
    return [Misplacement(views, float(np.abs(lengths[worst])), float(errors[worst]), float(np.median(depth)))]


def _motion(motions: Array, residuals: Array) -> tuple[Array, Array, Array]:
    """Return the least-squares motion along independent axes (metres), how many points constrain each, and the axes."""
    values, axes = np.linalg.eigh(motions.T @ motions)
    known = values > _TELLING
    values, axes = values[known], axes[:, known]
    return (axes.T @ (motions.T @ residuals)) / values, values, axes


def surface_offsets(
    here: PosedDepth, surface: SmoothSurface, other: PosedDepth, other_surface: SmoothSurface, spacing: int = _SPACING
) -> SurfaceOffsets:
    """Compare points of one view, ``spacing`` pixels apart, with the planes of the pixels that show them in another."""
    chosen = np.zeros_like(surface.is_sure)
    chosen[::spacing, ::spacing] = surface.is_sure[::spacing, ::spacing]
    rows, columns = np.nonzero(chosen)
    depth = here.depth[rows, columns].astype(np.float64)
    rotation = here.cam_to_world[:3, :3]
    points = (rays(here.intrinsics, columns, rows) * depth[:, None]) @ rotation.T + here.cam_to_world[:3, 3]
    normals = surface.normals[rows, columns] @ rotation.T

    seen = (points - other.cam_to_world[:3, 3]) @ other.cam_to_world[:3, :3]
    in_front = seen[:, 2] > 1e-9
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.floor((seen @ other.intrinsics.T)[:, :2] / seen[:, 2:])
    height, width = other.depth.shape
    in_image = in_front & (pixels >= 0).all(axis=1) & (pixels < [width, height]).all(axis=1)
    column, row = np.where(in_image[:, None], pixels, 0).astype(np.int64).T
    # The plane of the pixel that sees the point, so that a pixel's width does not count as distance.
    direction = rays(other.intrinsics, column, row)
    facing = other_surface.normals[row, column]
    offset = direction * other.depth[row, column].astype(np.float64)[:, None] - seen
    distance = (offset * facing).sum(axis=1)
    alike = (facing @ other.cam_to_world[:3, :3].T * normals).sum(axis=1)
    near = np.abs(other.depth[row, column] - seen[:, 2]) <= _REACH * seen[:, 2]
    kept = in_image & other_surface.is_sure[row, column] & near & (alike > 0.9)  # not the other side of a thin body
    pixels = np.stack([rows, columns], axis=1)
    return SurfaceOffsets(points[kept], normals[kept], distance[kept], depth[kept], pixels[kept])
