"""The frame loop of every scene: step the physics, note the state, draw all views."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.cameras import camera_intrinsics, camera_poses
from data_gen.renderers import Renderer
from data_gen.scene_settings import SceneSettings
from data_gen.stage_clock import StageClock
from vpd_lightning.data import schema


@dataclass(frozen=True)
class RenderedTrajectory:
    """The pictures of one trajectory."""

    rgb: NDArray[np.uint8]  # (time, view, height, width, 3)
    depth: NDArray[np.float32]  # (time, view, height, width) z-depth in metres, 0 = nothing
    segmentation: NDArray[np.uint8]  # (time, view, height, width)


def simulate_and_render(
    settings: SceneSettings,
    model: Any,
    data: Any,
    renderer: Renderer,
    clock: StageClock,
    check_stop: Callable[[], None],
    observe: Callable[[int], None],
    step: Callable[[int], None] | None = None,
) -> RenderedTrajectory:
    """Simulate and draw ``settings.num_frames`` frames from the state that ``data`` holds.

    ``check_stop`` is called before each frame and may raise; ``observe(frame)`` sees ``data`` as the frame shows it.
    ``step(frame)`` simulates up to a frame from the one before where something is driven on the way.
    """
    import mujoco

    camera = settings.camera
    shape = (settings.num_frames, camera.num_views, camera.height, camera.width)
    pictures = RenderedTrajectory(
        np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32), np.empty(shape, np.uint8)
    )
    for frame in range(settings.num_frames):
        check_stop()
        with clock.measure("simulate"):
            if frame and step is not None:
                step(frame)
            elif frame:
                mujoco.mj_step(model, data, settings.substeps)
            mujoco.mj_forward(model, data)  # poses of this very moment, not of one physics step ago
            observe(frame)
        with clock.measure("render"):
            renderer.render(data, pictures.rgb[frame], pictures.depth[frame], pictures.segmentation[frame])
    return pictures


def trajectory_of(
    settings: SceneSettings,
    pictures: RenderedTrajectory,
    *,
    state: Mapping[str, NDArray[Any]],
    seed: int,
    engine: str,
    scene_hash: str,
    attributes: Mapping[str, Any],
    action: Mapping[str, NDArray[Any]] | None = None,
) -> schema.Trajectory:
    """Return what the file of a generated trajectory holds; the rendered segmentation joins ``state``."""
    return schema.Trajectory(
        rgb=pictures.rgb,
        depth=pictures.depth,
        intrinsics=camera_intrinsics(settings.camera),
        cam_to_world=camera_poses(settings.camera),
        frame_time=settings.frame_time,
        near=settings.near,
        far=settings.far,
        workspace_min=tuple(settings.workspace_min),  # type: ignore[arg-type]
        workspace_max=tuple(settings.workspace_max),  # type: ignore[arg-type]
        seed=seed,
        engine=engine,
        scene_hash=scene_hash,
        attributes=attributes,
        action=action,
        state={**state, schema.STATE_SEGMENTATION: pictures.segmentation},
    )
