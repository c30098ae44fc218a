"""The mapping file for ROS bags: which topics are which camera.

YAML; only ``cameras`` with ``rgb`` and ``depth`` must be there::

    world_frame: world            # default: the root of the tf tree
    cameras:
      - name: left
        rgb: /left/color/image_raw
        depth: /left/aligned_depth_to_color/image_raw
        info: /left/color/camera_info         # default: the camera_info beside rgb
        frame: left_color_optical_frame       # default: frame_id of the colour images
        cam_to_world: [[1, 0, 0, 0.5], ...]   # 4x4, instead of tf; x right, y down, z forward
        depth_scale: 0.001                    # metres per step of 16-bit depth
        is_aligned: true                      # depth does fit colour, although frame_id or calibration differ
    robot:                                    # what its links did, by tf
      model: arm.urdf                         # URDF or MJCF with their shapes, beside the mapping
      frames: {world: base_link}              # tf frame of links that tf calls otherwise than the model
      points: 256                             # on all links together
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from data_gen.importers.conventions import checked_pose
from data_gen.importers.ros_robot import TrackedRobot, read_ros_robot
from data_gen.settings import did_you_mean
from vpd_lightning.errors import ConfigError, one_line

_TOP_KEYS = ("world_frame", "cameras", "robot")
_CAMERA_KEYS = ("name", "rgb", "depth", "info", "frame", "cam_to_world", "depth_scale", "is_aligned")


@dataclass(frozen=True)
class CameraTopics:
    """The topics of one camera, and what the user says about it; ``None`` leaves it to the bag."""

    rgb: str
    depth: str
    name: str = ""
    info: str | None = None
    frame: str | None = None
    cam_to_world: NDArray[np.float64] | None = None
    depth_scale: float | None = None
    is_aligned: bool = False


@dataclass(frozen=True)
class RosMapping:
    """What a mapping file says; no cameras means they are to be found."""

    cameras: tuple[CameraTopics, ...] = ()
    world_frame: str | None = None
    robot: TrackedRobot | None = None


def read_ros_mapping(path: Path) -> RosMapping:
    """Read a mapping file.

    Raises:
        ConfigError: it is missing, no YAML, or has unknown keys or wrong values.
        DataError: a ``cam_to_world`` is no rigid pose.
    """
    try:
        values = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"mapping={path} cannot be read as YAML ({one_line(error)}).") from error
    if not isinstance(values, dict) or not isinstance(values.get("cameras", []), list):
        raise ConfigError(f"{path}: 'cameras' with a list of rgb and depth topics was expected.")
    _refuse_unknown(values, _TOP_KEYS, path)
    cameras = tuple(_camera(entry, number, path) for number, entry in enumerate(values.get("cameras", [])))
    world_frame = values.get("world_frame")
    if world_frame is not None and not isinstance(world_frame, str):
        raise ConfigError(f"{path}: world_frame is {world_frame!r}; the name of a frame was expected.")
    robot = read_ros_robot(values["robot"], path) if "robot" in values else None
    return RosMapping(cameras, world_frame, robot)


def _camera(entry: Any, number: int, path: Path) -> CameraTopics:
    where = f"{path}: camera {number}"
    if not isinstance(entry, dict):
        raise ConfigError(f"{where} is not a group of settings (rgb: ..., depth: ...).")
    _refuse_unknown(entry, _CAMERA_KEYS, path)
    for key in ("rgb", "depth", "name", "info", "frame"):
        if not isinstance(entry.get(key, "" if key in ("name", "info", "frame") else None), str):
            raise ConfigError(f"{where}: {key} is {entry.get(key)!r}; a name was expected.")
    scale = entry.get("depth_scale")
    if scale is not None and (not isinstance(scale, int | float) or not 0 < scale < float("inf")):
        raise ConfigError(f"{where}: depth_scale is {scale!r}; metres per step were expected, for example 0.001.")
    pose = entry.get("cam_to_world")
    return CameraTopics(
        rgb=entry["rgb"],
        depth=entry["depth"],
        name=entry.get("name", ""),
        info=entry.get("info"),
        frame=entry.get("frame"),
        cam_to_world=None if pose is None else checked_pose(pose, f"{where}: cam_to_world"),
        depth_scale=None if scale is None else float(scale),
        is_aligned=bool(entry.get("is_aligned", False)),
    )


def _refuse_unknown(values: dict[Any, Any], known: tuple[str, ...], path: Path) -> None:
    for key in values:
        if key not in known:
            raise ConfigError(f"{path}: unknown key {key!r}{did_you_mean(str(key), known)}\nKeys: {', '.join(known)}.")
