"""What an import will write: which clips, from which images, in which world; and each clip made into a trajectory."""

import itertools
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.clips import Clip, plan_clips
from data_gen.importers.depth_cleanup import HoleFiller
from data_gen.importers.formats import open_format
from data_gen.importers.image_geometry import ImageGeometry
from data_gen.importers.pose_refinement import refine_poses
from data_gen.importers.recording import Recording
from data_gen.importers.scene_bounds import SceneBounds, sample_points, scene_bounds
from data_gen.importers.settings import ImportSettings
from data_gen.importers.world_frame import WorldFrame
from vpd_lightning.data.schema import VIEW_NAMES, Trajectory
from vpd_lightning.errors import ConfigError, DataError


@dataclass(frozen=True)
class Found:
    """What looking at images has shown: the world, its bounds, and refined poses (view, 4, 4) by recording."""

    frame: WorldFrame
    bounds: SceneBounds
    poses: Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True)
class ImportPlan:
    """What is to be written, and how the recordings become it; ``sources`` are as they were given, by name."""

    source: Path
    format: str
    settings: ImportSettings
    clips: list[Clip]
    sources: Mapping[str, Recording]
    geometries: Mapping[str, ImageGeometry]
    found: Found
    remarks: list[str]

    @property
    def frame(self) -> WorldFrame:
        """From the source's world to the data set's."""
        return self.found.frame

    @property
    def bounds(self) -> SceneBounds:
        """Workspace, near and far."""
        return self.found.bounds


def make_plan(path: Path, settings: ImportSettings, found: Found | None = None) -> ImportPlan:
    """List the recordings and decide everything that does not need all their images.

    ``found`` is what an earlier call found out by looking at images; with it none is read.
    """
    name, module = open_format(path, settings.format)
    recordings = list(itertools.islice(module.recordings(path, settings), settings.max_recordings))
    if not recordings:
        raise DataError(f"{path} holds no recording.")
    names = [recording.name for recording in recordings]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DataError(f"{path} has two recordings named {twice!r}; rename one.")
    clips, remarks = plan_clips(recordings, settings)
    kept = {clip.recording.name: clip.recording for clip in clips}
    geometries = {name: ImageGeometry(recording, settings) for name, recording in kept.items()}
    _require_one_shape(geometries)
    _require_fixed_cameras_to_fill_holes(kept, settings)
    if found is None:
        found, lines = _look(geometries, settings)
        remarks += lines
    if found.poses:
        geometries = {
            name: ImageGeometry(replace(recording, cam_to_world=found.poses[name]), settings)
            for name, recording in kept.items()
        }
    return ImportPlan(path, name, settings, clips, kept, geometries, found, remarks)


def _look(geometries: Mapping[str, ImageGeometry], settings: ImportSettings) -> tuple[Found, list[str]]:
    """Look at images to find out what the source does not say."""
    poses: Mapping[str, NDArray[np.float64]] = {}
    remarks: list[str] = []
    if settings.refine_poses:
        refined = refine_poses(geometries, settings.every, settings.scale or 1.0)
        poses, remarks = refined.poses, list(refined.remarks)
        geometries = {
            name: ImageGeometry(replace(geometry.recording, cam_to_world=poses[name]), settings)
            for name, geometry in geometries.items()
        }
    frame = WorldFrame(settings.up, settings.scale or 1.0)
    points = sample_points(list(geometries.values()), frame, settings.every)
    if settings.recenter:
        shift = -np.round(np.median(points.positions, axis=0), 6)
        frame = WorldFrame(settings.up, settings.scale or 1.0, shift)
    bounds = scene_bounds(points, frame.shift, settings)
    if bounds.ground is not None:
        remarks.append(
            f"the ground at z = {bounds.ground:.2f} m counts for the workspace only around what stands on it"
        )
    return Found(frame, bounds, poses), remarks


def clip_trajectory(
    plan: ImportPlan, clip: Clip, scene_hash: str, check_stop: Callable[[], None] = lambda: None
) -> Trajectory:
    """Read and convert all images of one clip; ``check_stop`` is called before each frame and may raise."""
    geometry, settings = plan.geometries[clip.recording.name], plan.settings
    recording = geometry.recording
    shape = (len(clip.frames), recording.num_views, geometry.height, geometry.width)
    rgb, depth = np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32)
    fillers = [HoleFiller(settings.fill_holes or 0) for _ in range(recording.num_views)]
    for time, frame in enumerate(clip.frames):
        check_stop()
        for view in range(recording.num_views):
            rgb[time, view] = geometry.rgb(frame, view)
            measured = plan.frame.depth(geometry.depth(frame, view))
            depth[time, view] = fillers[view](measured) if settings.fill_holes else measured
    intrinsics, poses = geometry.intrinsics(), plan.frame.poses(recording.cam_to_world)
    kept = list(clip.frames)
    return Trajectory(
        rgb=rgb,
        depth=depth,
        intrinsics=intrinsics if intrinsics.ndim == 3 else intrinsics[kept],
        cam_to_world=poses if poses.ndim == 3 else poses[kept],
        frame_time=recording.frame_time * settings.every,
        near=plan.bounds.near,
        far=plan.bounds.far,
        workspace_min=plan.bounds.workspace_min,
        workspace_max=plan.bounds.workspace_max,
        seed=settings.seed,
        source_depth_type=recording.source.get("depth_type", "z"),
        engine=f"imported from {plan.format}",
        scene_hash=scene_hash,
        action=None if recording.driven is None else plan.frame.driven(recording.driven.at(kept)).as_arrays(),
        attributes=_attributes(plan, clip),
    )


def _attributes(plan: ImportPlan, clip: Clip) -> dict[str, Any]:
    """Return what a reader may want to know of the source; ``recording`` keeps clips of one recording together."""
    recording, settings = clip.recording, plan.settings
    poses = plan.found.poses.get(recording.name)
    found = {f"source_{key}": value for key, value in recording.source.items() if key not in ("format", "depth_type")}
    if poses is not None:
        moved = np.linalg.norm(poses[:, :3, 3] - recording.cam_to_world[:, :3, 3], axis=1)
        found["source_poses_moved"] = moved * plan.frame.scale  # metres, of each view
    if recording.view_names:
        found[VIEW_NAMES] = json.dumps(list(recording.view_names))
    return {
        **found,
        "recording": recording.name,
        "clip": clip.number,
        "source_format": plan.format,
        "source_first_frame": clip.frames[0],
        "source_every": settings.every,
        "source_frame_time": recording.frame_time,
        "source_scale": plan.frame.scale,
        "source_up": plan.frame.up,
        "source_shift": plan.frame.shift,
        "source_size": np.array([recording.width, recording.height]),
        "source_undistorted": recording.distortion is not None,
    }


def _require_fixed_cameras_to_fill_holes(recordings: Mapping[str, Recording], settings: ImportSettings) -> None:
    moving = [name for name, one in recordings.items() if one.cam_to_world.ndim == 4 or one.intrinsics.ndim == 4]
    if settings.fill_holes and moving:
        raise ConfigError(
            f"fill_holes={settings.fill_holes} needs cameras that stand still, but those of {moving[0]} move: what a "
            "pixel showed before lies elsewhere.\nRemove fill_holes."
        )


def _require_one_shape(geometries: Mapping[str, ImageGeometry]) -> None:
    shapes: dict[tuple[int, int, int], str] = {}
    for name, geometry in geometries.items():
        shapes.setdefault((geometry.recording.num_views, geometry.height, geometry.width), name)
    if len(shapes) > 1:
        listed = "; ".join(f"{v} views of {w}x{h} in {name}" for (v, h, w), name in list(shapes.items())[:3])
        raise DataError(
            f"The recordings differ in views or size: {listed}.\nA data set has one shape: set height= and width= "
            "(and crop=), or import the kinds into data sets of their own."
        )
