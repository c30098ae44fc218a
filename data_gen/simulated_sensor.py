"""A generated trajectory as a simulated sensor would have recorded it; the truth moves to the ground truth."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.scene_settings import SceneSettings
from vpd_lightning.data import schema
from vpd_lightning.data.sensors import Sensor, SensorSettings
from vpd_lightning.data.sensors.sensor import median_depth
from vpd_lightning.errors import ConfigError

_OVER_TIME = (
    schema.STATE_POSITIONS, schema.STATE_QUATERNIONS, schema.STATE_LINEAR_VELOCITIES, schema.STATE_ANGULAR_VELOCITIES,
    schema.STATE_SEGMENTATION, schema.STATE_VERTICES, schema.ACTION_POINTS, schema.ACTION_NORMALS, schema.ACTION_POSES,
    schema.ACTION_COMMANDED_POSES,
)  # fmt: skip


def rendered_settings(settings: SceneSettings, sensor: SensorSettings) -> Any:
    """Return the settings to render with: where cameras are triggered late, with frames in between.

    Raises:
        ConfigError: a frame time is no whole number of physics steps for each of these frames, or the offset is longer
            than a frame time.
    """
    if sensor.trigger_offset <= 0:
        return settings
    steps = sensor.trigger_steps
    if sensor.trigger_offset > settings.frame_time:
        raise ConfigError(
            f"sensor.trigger_offset={sensor.trigger_offset} is longer than a frame time, {settings.frame_time:.4g} s."
        )
    if settings.substeps % steps:
        allowed = [number for number in range(2, min(settings.substeps, 100) + 1) if settings.substeps % number == 0]
        raise ConfigError(
            f"sensor.trigger_steps={steps} does not divide the {settings.substeps} physics steps of a frame, so there "
            f"are no frames in between.\nAllowed here: {', '.join(map(str, allowed)) or 'none; lower timestep'}."
        )
    fine = (settings.num_frames - 1) * steps + 1 + steps
    if fine > 10_000:
        raise ConfigError(f"{fine} frames would have to be drawn for each trajectory. Lower sensor.trigger_steps.")
    return replace(settings, num_frames=fine, frame_time=settings.frame_time / steps)


def measured(
    trajectory: schema.Trajectory, settings: SceneSettings, sensor: SensorSettings, seed: int, name: str
) -> schema.Trajectory:
    """Return what a sensor records of a trajectory that was drawn with ``rendered_settings``.

    True depth and poses are in its ground truth, as is what holds at the frame's own time whatever the trigger.
    """
    stride = sensor.trigger_steps if sensor.trigger_offset > 0 else 1
    middle = median_depth(trajectory.depth[0], trajectory.far)
    errors = Sensor(sensor, seed=seed, trajectory=name, median_depth=middle)
    shape = (settings.num_frames, *trajectory.depth.shape[1:])
    rgb, depth = np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32)
    poses = np.empty_like(trajectory.cam_to_world)
    for view in range(shape[1]):
        late = errors.trigger_step(view, settings.frame_time) if stride > 1 else 0
        poses[view] = errors.measure_pose(trajectory.cam_to_world[view], view)
        for frame in range(shape[0]):
            drawn = frame * stride + late
            depth[frame, view] = errors.measure_depth(
                trajectory.depth[drawn, view], trajectory.intrinsics[view], frame, view
            )
            rgb[frame, view] = errors.measure_rgb(trajectory.rgb[drawn, view], frame, view)
    frames = slice(0, (settings.num_frames - 1) * stride + 1, stride)
    state = _chosen(trajectory.state or {}, frames)
    state |= {schema.STATE_DEPTH: trajectory.depth[frames], schema.STATE_CAM_TO_WORLD: trajectory.cam_to_world}
    return replace(
        trajectory,
        rgb=rgb,
        depth=depth,
        cam_to_world=poses,
        frame_time=settings.frame_time,
        state=state,
        action=None if trajectory.action is None else _chosen(trajectory.action, frames),
    )


def _chosen(arrays: Mapping[str, NDArray[Any]], frames: slice) -> dict[str, NDArray[Any]]:
    return {key: value[frames] if key in _OVER_TIME else value for key, value in arrays.items()}
