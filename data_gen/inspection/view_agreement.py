"""How far apart two views place the same surface, under any assumed camera convention.

The depth of one image is unprojected, the points are looked up in another image, and depths are compared. The look-up
interpolates inverse depth between the four nearest pixels: inverse depth is affine in the image of a plane, so that
correct views of planes agree to rounding and half a pixel shows. Edges, where the four differ much, are left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_gen.inspection.camera_conventions import STORED, CameraConvention, single_mistakes, with_shifts, without_shift
from data_gen.inspection.posed_depth import Array, ImageKey, PosedDepth, choose_pairs, rays, read_posed_depth
from vpd_lightning.data.reader import TrajectoryReader

MIN_SHARED = 50  # points that two images must share to be compared
MAX_PAIRS = 12
_MAX_POINTS = 1_000  # per pair
_MAX_STEP = 0.1  # relative difference of the four pixels around a point, beyond which there is an edge
_NUM_REFINED = 6  # conventions that are tried with a shifted principal point as well
_FLOOR = 3e-5  # of the depth: what rendering and float32 leave of an exact match
_CLEARLY_BETTER = 0.4  # a convention explains the data when it leaves at most this share of the distance ...
_BETTER_IN_PAIR = 0.6  # ... and at most this share of it ...
_MOST_PAIRS = 0.75  # ... in at least this share of the pairs
_MIN_OVERLAP = 0.3  # of the points that the convention with the most overlap can compare
_SAME = 1.5  # two conventions that leave distances within this factor cannot be distinguished


@dataclass(frozen=True)
class Score:
    """How well one convention makes the images agree.

    ``distances`` holds, per pair, the median over the better half of the points (which leaves out occlusions and what
    moves) of the distance relative to depth; NaN where too few points are shared.
    """

    distances: Array
    num_points: int

    @property
    def distance(self) -> float:
        """Median over the pairs; infinite where no pair shares enough points."""
        valid = np.isfinite(self.distances)
        return float(np.median(self.distances[valid])) if valid.any() else float("inf")


@dataclass(frozen=True)
class Agreement:
    """What comparing the images of one file says. ``explanation`` is set where another convention fits decisively."""

    distance: float  # relative to depth; infinite where the views share nothing
    num_pairs: int
    is_over_time: bool  # every pair is one view at two times
    explanation: CameraConvention | None
    explained_distance: float
    undecidable: tuple[CameraConvention, ...]  # single mistakes that would look the same
    errors: dict[str, float]  # distance by convention, for those that were tried


def compare_views(reader: TrajectoryReader, max_pairs: int = MAX_PAIRS) -> Agreement | None:
    """Compare images of one file under all conventions; None where there is no second look at anything."""
    pairs = choose_pairs(reader, max_pairs)
    if not pairs:
        return None
    images = read_posed_depth(reader, [key for pair in pairs for key in pair])
    scores = _score_all(images, pairs)
    most = max(score.num_points for score in scores.values())
    usable = {
        convention: score
        for convention, score in scores.items()
        if score.num_points >= max(MIN_SHARED, _MIN_OVERLAP * most) and np.isfinite(score.distance)
    }
    stored = scores[STORED]
    best = _choose(usable, images, reader)
    explanation = best if best is not None and best != STORED and _explains(scores[best], stored) else None
    undecidable: tuple[CameraConvention, ...] = ()
    if explanation is None and STORED in usable:
        same = max(_SAME * stored.distance, _FLOOR)
        undecidable = tuple(r for r in single_mistakes() if r in usable and scores[r].distance <= same)
    return Agreement(
        distance=stored.distance,
        num_pairs=int(np.isfinite(stored.distances).sum()),
        is_over_time=all(first[0] != second[0] for first, second in pairs),
        explanation=explanation,
        explained_distance=scores[best].distance if best is not None else float("inf"),
        undecidable=undecidable,
        errors={str(convention): score.distance for convention, score in scores.items()},
    )


def _score_all(
    images: dict[ImageKey, PosedDepth], pairs: Sequence[tuple[ImageKey, ImageKey]]
) -> dict[CameraConvention, Score]:
    """Score every combination; those of the principal point, whose effect is small, only on top of the best others."""
    samples = {key: _sample(image) for key, image in images.items()}
    scores = {convention: _score(convention, images, pairs, samples) for convention in without_shift()}
    ranked = sorted(scores, key=lambda convention: scores[convention].distance)[:_NUM_REFINED]
    for convention in dict.fromkeys([STORED, *ranked]):
        scores |= {shifted: _score(shifted, images, pairs, samples) for shifted in with_shifts(convention)}
    return scores


def _choose(
    usable: dict[CameraConvention, Score], images: dict[ImageKey, PosedDepth], reader: TrajectoryReader
) -> CameraConvention | None:
    """The convention that fits best; among equals the stored one, else the most plausible and simple."""
    if not usable:
        return None
    least = min(score.distance for score in usable.values())
    equal = [convention for convention, score in usable.items() if score.distance <= max(_SAME * least, _FLOOR)]
    if STORED in equal:
        return STORED
    fewest = min(len(convention.changes) for convention in equal)
    simple = [convention for convention in equal if len(convention.changes) == fewest]
    return max(simple, key=lambda convention: (_plausibility(convention, images, reader), -usable[convention].distance))


def _explains(candidate: Score, stored: Score) -> bool:
    if not np.isfinite(stored.distance):
        return candidate.distance <= 0.01 and bool(np.isfinite(candidate.distances).mean() >= 0.5)
    if stored.distance <= _FLOOR or candidate.distance > _CLEARLY_BETTER * stored.distance:
        return False
    both = np.isfinite(candidate.distances) & np.isfinite(stored.distances)
    is_better = candidate.distances[both] <= _BETTER_IN_PAIR * stored.distances[both]
    return not both.any() or bool(is_better.mean() >= _MOST_PAIRS)


def _plausibility(convention: CameraConvention, images: dict[ImageKey, PosedDepth], reader: TrajectoryReader) -> float:
    """Share of the points in the workspace plus share of the depths between near and far, to one digit."""
    inside, within = [], []
    for image in images.values():
        read = convention.read(image)
        points = read.points()[::7]
        if not len(points):
            continue
        inside.append(((points >= reader.workspace_min) & (points <= reader.workspace_max)).all(axis=-1).mean())
        lengths = np.linalg.norm(points - read.cam_to_world[:3, 3], axis=-1)
        within.append(((lengths >= reader.near) & (lengths <= reader.far)).mean())
    return round(float(np.mean(inside) + np.mean(within)), 1) if inside else 0.0


def _sample(image: PosedDepth) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of some measured pixels, the same for every convention."""
    rows, columns = np.nonzero(image.depth > 0)
    if len(rows) > _MAX_POINTS:
        kept = np.random.default_rng(0).choice(len(rows), _MAX_POINTS, replace=False)
        rows, columns = rows[kept], columns[kept]
    return rows, columns


def _score(
    convention: CameraConvention,
    images: dict[ImageKey, PosedDepth],
    pairs: Sequence[tuple[ImageKey, ImageKey]],
    samples: dict[ImageKey, tuple[NDArray[np.int64], NDArray[np.int64]]],
) -> Score:
    cameras = {
        key: (convention.intrinsics(image.intrinsics), convention.pose(image.cam_to_world))
        for key, image in images.items()
    }
    distances, num_points = [], 0
    for first, second in pairs:
        rows, columns = samples[first]
        intrinsics, pose = cameras[first]
        directions = rays(intrinsics, columns, rows)
        depth = convention.z_depth(images[first].depth[rows, columns].astype(np.float64), directions)
        points = (directions * depth[:, None]) @ pose[:3, :3].T + pose[:3, 3]
        relative = np.abs(_relative_distances(convention, points, images[second].depth, *cameras[second]))
        num_points += len(relative)
        distances.append(float(np.quantile(relative, 0.25)) if len(relative) >= MIN_SHARED else np.nan)
    return Score(np.array(distances), num_points)


def _relative_distances(
    convention: CameraConvention, points: Array, depth: NDArray[np.float32], intrinsics: Array, cam_to_world: Array
) -> Array:
    """Distance of world ``points`` behind the surface of another view, over its depth, where that view is smooth."""
    seen = (points - cam_to_world[:3, 3]) @ cam_to_world[:3, :3]
    seen = seen[seen[:, 2] > 1e-9]
    pixels = (seen @ intrinsics.T)[:, :2] / seen[:, 2:] - 0.5
    height, width = depth.shape
    column, row = np.floor(pixels).T
    is_inside = (column >= 0) & (column < width - 1) & (row >= 0) & (row < height - 1)
    seen, pixels = seen[is_inside], pixels[is_inside]
    column, row = column[is_inside].astype(np.int64), row[is_inside].astype(np.int64)
    across, down = pixels[:, 0] - column, pixels[:, 1] - row
    corners = []
    for right, below in ((0, 0), (1, 0), (0, 1), (1, 1)):
        measured = depth[row + below, column + right].astype(np.float64)
        z = convention.z_depth(
            measured, rays(intrinsics, column + right, row + below) if convention.ray_power else None
        )
        corners.append(np.divide(1.0, z, out=np.zeros_like(z), where=z > 0))
    stacked = np.stack(corners)
    low, high = stacked.min(axis=0), stacked.max(axis=0)
    is_smooth = (low > 0) & (high - low <= _MAX_STEP * high)
    top = corners[0] * (1 - across) + corners[1] * across
    bottom = corners[2] * (1 - across) + corners[3] * across
    inverse = top * (1 - down) + bottom * down
    return (seen[:, 2] * inverse - 1.0)[is_smooth]
