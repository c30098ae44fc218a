"""Poses of cameras that stand still, refined by laying the surfaces that they see onto each other.

Point-to-plane ICP (Chen and Medioni 1992) over all views at once: points of each view are compared with the planes of
the pixels that show them in every other view, and all motions that make them agree come from one linear system, again
and again. What no surface determines, as sliding along a bare floor, stays as it was given. The first view stays where
it is: it carries the world. Points are paired by projection, which knows what a view can see; nearest points, as ICP
libraries pair them, move views across what only one of them sees.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.spatial.transform import Rotation

from data_gen.importers.image_geometry import ImageGeometry
from data_gen.inspection.pose_agreement import SurfaceOffsets, surface_offsets
from data_gen.inspection.posed_depth import PosedDepth
from data_gen.inspection.smooth_surface import SmoothSurface, smooth_surface
from vpd_lightning.errors import ConfigError, DataError

Array = NDArray[np.float64]

_MAX_RECORDINGS = 3  # of one camera arrangement
_MAX_FRAMES = 7  # of each; the median over them leaves what stands still, with less noise
_REACHES = (0.06, 0.06, 0.03, 0.03, *(0.015,) * 4, *(0.0075,) * 12)  # of the depth: offsets up to there count
_TOLD = 8.0  # points that face a motion, or as many more that it passes at an angle, for it to be determined
_TILTED = 3.0  # times what noise would feign: it tilts the normals of a floor, which then seems to determine a slide
_NORMALS = 9  # pixels across which normals are compared, to find out how far noise tilts them
_BETTER = 0.99  # of the disagreement before; where refined poses leave more, those given are kept
_SURE = 3.0  # standard errors that a step must have
_SHARED = 0.03  # of a picture's pixels: two views that share fewer are not compared
_FAR = 2.0  # times the median depth: beyond it a pixel is too coarse to tell anything
_MAX_SHIFT, _MAX_TURN = 0.1, 10.0  # of the median depth, and degrees: farther off is no calibration
_FAR_SHIFT = 0.03  # of the median depth; what was moved farther is pointed out


@dataclass(frozen=True)
class RefinedPoses:
    """Refined cam_to_world (view, 4, 4) by the name of each recording, and what to tell the user."""

    poses: Mapping[str, Array]
    remarks: Sequence[str]


@dataclass(frozen=True)
class _Scenery:
    """What stands still before all cameras during one recording; poses are the camera's own (identity)."""

    images: Sequence[PosedDepth]
    surfaces: Sequence[SmoothSurface]

    @cached_property
    def tilt(self) -> float:
        """Variance of normals on smooth surfaces, in each direction."""
        return float(np.median(np.concatenate([_tilt(surface) for surface in self.surfaces])))


@dataclass(frozen=True)
class _Step:
    """Poses (view, 4, 4), which views share surfaces with others (view,), and how many parts of motions were kept."""

    poses: Array
    is_seen: NDArray[np.bool_]
    num_kept: int


def refine_poses(geometries: Mapping[str, ImageGeometry], every: int, unit: float = 1.0) -> RefinedPoses:
    """Refine the poses of all recordings; those with the same cameras in the same places are refined together.

    ``every`` keeps every n-th frame; ``unit`` is metres per unit of the source, for what is told.

    Raises:
        ConfigError: there is one view, or cameras move.
        DataError: a pose is too far off to be refined.
    """
    arrangements: dict[bytes, list[str]] = {}
    for name, geometry in geometries.items():
        recording = geometry.recording
        if recording.num_views < 2 or recording.cam_to_world.ndim == 4 or recording.intrinsics.ndim == 4:
            fault = "has one view" if recording.num_views < 2 else "has cameras that move"
            raise ConfigError(
                f"refine_poses=true compares what several fixed cameras see, but {name} {fault}.\nRemove refine_poses."
            )
        key = recording.cam_to_world.tobytes() + geometry.intrinsics().tobytes()
        arrangements.setdefault(key, []).append(name)
    poses: dict[str, Array] = {}
    remarks = []
    for names in arrangements.values():
        chosen = names[:: max(1, -(-len(names) // _MAX_RECORDINGS))]
        refined, lines = _refine([geometries[name] for name in chosen], every, unit)
        poses.update(dict.fromkeys(names, refined))
        others = f" and {len(names) - 1} more" if len(names) > 1 else ""
        remarks += [f"refined poses of {names[0]}{others}:", *(f"  {line}" for line in lines)]
    return RefinedPoses(poses, remarks)


def _refine(geometries: Sequence[ImageGeometry], every: int, unit: float) -> tuple[Array, list[str]]:
    """Return poses (view, 4, 4) and lines for a person."""
    first = geometries[0].recording
    sceneries = [_scenery(geometry, every) for geometry in geometries]
    given = first.cam_to_world
    step = _Step(given, np.zeros(first.num_views, bool), 0)
    for reach in _REACHES:
        step = _next(sceneries, step.poses, reach)
    if not _disagreement(sceneries, step.poses) < _BETTER * _disagreement(sceneries, given):
        step = replace(step, poses=given)
    poses = step.poses
    before, after = (_median_distance(sceneries, each) for each in (given, poses))
    lines = []
    depths = np.concatenate([image.depth[image.depth > 0] for scenery in sceneries for image in scenery.images])
    for view in range(1, first.num_views):
        label = f"view {view}" + (f" ({first.view_names[view]})" if first.view_names else "")
        if not step.is_seen[view]:
            lines.append(f"{label}: shares too little with the others, and stays as it was given")
            continue
        moved = float(np.linalg.norm(poses[view, :3, 3] - given[view, :3, 3]))
        turn = np.degrees(Rotation.from_matrix(poses[view, :3, :3] @ given[view, :3, :3].T).magnitude())
        if moved > _MAX_SHIFT * np.median(depths) or turn > _MAX_TURN:
            raise DataError(
                f"{label}: the pose that fits the surfaces is {100 * unit * moved:.1f} cm and {turn:.1f} degrees "
                "from the one given, too far for a refinement.\nCalibrate the cameras again, or import without "
                "refine_poses and let vpd-data validate say which convention is wrong."
            )
        far = moved > _FAR_SHIFT * np.median(depths)
        doubt = "; far for a refinement: look at points.png of vpd-data inspect" if far else ""
        lines.append(f"{label}: moved by {1000 * unit * moved:.1f} mm, turned by {turn:.2f} degrees{doubt}")
    if step.num_kept:
        parts = 6 * (first.num_views - 1)
        lines.append(f"the surfaces do not determine {step.num_kept} of the {parts} parts of these motions: kept")
    if np.isfinite(after):
        millimetres = [f"{1000 * unit * distance:.1f} mm" for distance in (after, before)]
        lines.append(f"what two views see lies {millimetres[0]} apart (median); before, {millimetres[1]}")
    return poses, lines


def _scenery(geometry: ImageGeometry, every: int) -> _Scenery:
    """Take the median over frames of each view's depth, where most of them have one."""
    recording, images = geometry.recording, []
    frames = range(0, recording.num_frames, every)
    times = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), _MAX_FRAMES)).round().astype(int))
    for view in range(recording.num_views):
        depth = np.stack([geometry.depth(frames[time], view) for time in times])
        is_measured = depth > 0
        is_mostly = is_measured.sum(axis=0) > len(times) / 2
        median = np.nanmedian(np.where(is_measured | ~is_mostly, depth, np.nan), axis=0)
        is_near = is_mostly & (median <= _FAR * np.median(median[is_mostly])) if is_mostly.any() else is_mostly
        still = np.where(is_near, median, 0).astype(np.float32)
        images.append(PosedDepth(still, geometry.intrinsics()[view], np.eye(4)))
    return _Scenery(images, [smooth_surface(image) for image in images])


def _tilt(surface: SmoothSurface) -> Array:
    """Return the variance (pixel,) of normals around each sure pixel, in each direction."""
    weights = surface.is_sure.astype(np.float64)
    share = np.maximum(uniform_filter(weights, _NORMALS), 1e-9)
    mean = np.stack([uniform_filter(surface.normals[..., i] * weights, _NORMALS) / share for i in range(3)], axis=-1)
    return (0.5 * (1 - (mean**2).sum(axis=-1)))[surface.is_sure]


def _offsets(sceneries: Sequence[_Scenery], poses: Array) -> Iterator[tuple[int, int, SurfaceOffsets]]:
    """Yield what the points of one view miss another's surfaces by, for pairs of views that share enough of them."""
    for scenery in sceneries:
        placed = [replace(image, cam_to_world=pose) for image, pose in zip(scenery.images, poses, strict=True)]
        for one, other in permutations(range(len(placed)), 2):
            surfaces = scenery.surfaces[one], scenery.surfaces[other]
            offsets = surface_offsets(placed[one], surfaces[0], placed[other], surfaces[1], spacing=1)
            if len(offsets.points) >= _SHARED * placed[one].depth.size:
                yield one, other, offsets


def _next(sceneries: Sequence[_Scenery], poses: Array, reach: float) -> _Step:
    """Take one step of ICP; ``reach`` is the share of depth up to which offsets count."""
    num_views = len(poses)
    found = list(_offsets(sceneries, poses))
    if not found:
        return _Step(poses, np.zeros(num_views, bool), 6 * (num_views - 1))
    points = np.concatenate([offsets.points for _, _, offsets in found])
    center = np.median(points, axis=0)
    radius = float(np.median(np.linalg.norm(points - center, axis=1)))  # a turn counts by how far it moves this point
    information, wanted = np.zeros((num_views, 6, num_views, 6)), np.zeros((num_views, 6))
    scatter = 1.4826 * np.median(np.concatenate([np.abs(offsets.distances) for _, _, offsets in found]))
    for one, other, offsets in found:
        near = np.abs(offsets.distances) <= reach * offsets.depth
        normals = offsets.normals[near]
        arms = np.cross((offsets.points[near] - center) / radius, normals)
        parts = np.concatenate([normals, arms], axis=1)  # of a motion of the points; of the surface, the negative
        square, pull = parts.T @ parts, parts.T @ offsets.distances[near]
        for view, sign in ((one, 1), (other, -1)):
            wanted[view] += sign * pull
            information[view, :, view] += square
        information[one, :, other] -= square
        information[other, :, one] -= square
    size = 6 * (num_views - 1)  # the first view stays
    values, axes = np.linalg.eigh(information[1:, :, 1:].reshape(size, size))
    tilt = np.median([scenery.tilt for scenery in sceneries])
    is_known = values > _TOLD + _TILTED * tilt * len(points)
    asked = axes.T @ wanted[1:].ravel()
    is_sure = is_known & (np.abs(asked) > _SURE * scatter * np.sqrt(np.maximum(values, 0)))
    solution = axes[:, is_sure] @ (asked[is_sure] / values[is_sure])
    motions = np.tile(np.eye(4), (num_views, 1, 1))
    for view, part in enumerate(solution.reshape(-1, 6), 1):
        motions[view, :3, :3] = Rotation.from_rotvec(part[3:] / radius).as_matrix()
        motions[view, :3, 3] = center + part[:3] - motions[view, :3, :3] @ center
    own = np.array([np.trace(information[view, :, view]) for view in range(num_views)])
    return _Step(motions @ poses, own > _TOLD, int((~is_known).sum()))


def _disagreement(sceneries: Sequence[_Scenery], poses: Array) -> float:
    """Return the mean square of offsets as shares of depth; beyond the last reach they count as much as there."""
    shares = [offsets.distances / offsets.depth for _, _, offsets in _offsets(sceneries, poses)]
    return float((np.minimum(np.abs(np.concatenate(shares)), _REACHES[-1]) ** 2).mean()) if shares else 0.0


def _median_distance(sceneries: Sequence[_Scenery], poses: Array) -> float:
    """Return how far points lie from the surfaces of other views, metres; NaN where no view sees another's."""
    distances = [np.abs(offsets.distances) for _, _, offsets in _offsets(sceneries, poses)]
    return float(np.median(np.concatenate(distances))) if distances else float("nan")
