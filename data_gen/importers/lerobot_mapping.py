"""The mapping file of a LeRobot data set: which features are a view's colour, depth, intrinsics and pose."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from data_gen.importers.conventions import camera_matrix, checked_intrinsics, checked_pose
from data_gen.importers.lerobot_robot import MappedRobot, read_robot
from data_gen.importers.source_files import choice, number
from data_gen.settings import did_you_mean
from vpd_lightning.errors import ConfigError, DataError

_MAX_BYTES = 2**20
_MAX_VIEWS = 256
_KEYS = (
    "name",
    "rgb",
    "depth",
    "depth_range",
    "depth_log",
    "depth_shift",
    "depth_unit",
    "depth_type",
    "intrinsics",
    "pixel_center",
    "distortion",
    "cam_to_world",
    "world_to_cam",
    "axes",
    "quaternion",
)
_AXES = {"opencv": "x right, y down, z forward", "opengl": "x right, y up, z back"}
_PIXEL_CENTERS = {0.0: "OpenCV, ROS, RealSense", 0.5: "renderers, COLMAP"}
_DEPTH_TYPES = {"z": "along the optical axis", "distance": "to the camera centre"}
_QUATERNIONS = {"wxyz": "MuJoCo", "xyzw": "ROS, SciPy"}


@dataclass(frozen=True)
class DepthCodes:
    """How a 12-bit video codes depth: 0 is ``low``, 4095 ``high`` metres; even steps, or even in log(depth + shift)."""

    low: float
    high: float
    is_log: bool
    shift: float

    def metres(self, codes: NDArray[np.uint16]) -> NDArray[np.float32]:
        """Return depth; 0 for the first and last code, which also hold everything out of range (and no measurement)."""
        share = codes.astype(np.float64) / 4095
        if self.is_log:
            first, last = np.log(self.low + self.shift), np.log(self.high + self.shift)
            depth = np.exp(first + share * (last - first)) - self.shift
        else:
            depth = self.low + share * (self.high - self.low)
        return np.where((codes > 0) & (codes < 4095), depth, 0.0).astype(np.float32)


@dataclass(frozen=True)
class MappedView:
    """One view. ``intrinsics`` and ``pose`` are a feature's name, or the constant matrix."""

    name: str
    rgb: str
    depth: str
    intrinsics: str | NDArray[np.float64]
    pose: str | NDArray[np.float64]
    is_world_to_cam: bool
    axes: str
    pixel_center: float
    depth_type: str
    depth_unit: float | None
    depth_codes: Mapping[str, Any]  # depth_range, depth_log, depth_shift, where given
    quaternion: str | None
    distortion: NDArray[np.float64] | None

    def codes(self, info: Mapping[str, Any]) -> DepthCodes:
        """Return the coding of depth: the mapping's, else what the feature's ``info`` in ``meta/info.json`` says."""
        where = f"mapping, view {self.name}"

        def noted(key: str) -> Any:
            return info.get(f"video.{key}", info.get(key))

        given = self.depth_codes.get("depth_range", [noted("depth_min"), noted("depth_max")])
        is_pair = isinstance(given, list) and len(given) == 2
        if not is_pair or not all(isinstance(x, int | float) and np.isfinite(x) for x in given):
            raise ConfigError(
                f"{where}: {self.depth} is a video; say which metres its codes cover: depth_range: [0.01, 10]"
            )
        low, high = map(float, given)
        is_log = bool(self.depth_codes.get("depth_log", noted("use_log") or False))
        shift = float(self.depth_codes.get("depth_shift", noted("shift") or 0.0))
        if not 0 <= low < high or (is_log and low + shift <= 0):
            raise ConfigError(f"{where}: depth_range {given} (shift {shift:g}) is empty or has no logarithm.")
        return DepthCodes(low, high, is_log, shift)


@dataclass(frozen=True)
class LeRobotMapping:
    """What the features of a data set are; ``robot`` is None where the mapping names none."""

    views: list[MappedView]
    robot: MappedRobot | None


def read_lerobot_mapping(file: str | None) -> LeRobotMapping:
    """Read the YAML file named by the setting ``mapping``.

    Raises:
        ConfigError: not given, not there, or with unknown or missing entries.
    """
    if file is None:
        raise ConfigError(
            "LeRobot data sets have no standard names for depth, intrinsics and poses.\n"
            "Name them in a YAML file: mapping=FILE; docs/your_data.md has an example."
        )
    path = Path(file).expanduser()
    if not path.is_file():
        raise ConfigError(f"mapping={file}: there is no such file.")
    if path.stat().st_size > _MAX_BYTES:
        raise ConfigError(f"mapping={file} has {path.stat().st_size} bytes, more than the allowed {_MAX_BYTES}.")
    try:
        content = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path} cannot be read as YAML: {' '.join(str(error).split())[:200]}.") from error
    views = content.get("views") if isinstance(content, dict) else None
    if not isinstance(views, list) or not 0 < len(views) <= _MAX_VIEWS or not all(isinstance(x, dict) for x in views):
        raise ConfigError(
            f"{path}: 'views' must be a list of cameras, each with name, rgb, depth, intrinsics, a pose ..."
        )
    try:
        mapped = [_view(entry, f"{path}: view {entry.get('name', index)}") for index, entry in enumerate(views)]
    except DataError as error:  # the mapping is a setting, not data
        raise ConfigError(str(error)) from error
    return LeRobotMapping(mapped, read_robot(content["robot"], path) if "robot" in content else None)


def _view(entry: dict[str, Any], where: str) -> MappedView:
    for key in entry:
        if key not in _KEYS:
            raise ConfigError(f"{where}: unknown key {key!r}{did_you_mean(str(key), _KEYS)}\nKeys: {', '.join(_KEYS)}.")
    for key in ("name", "rgb", "depth"):
        if not isinstance(entry.get(key), str):
            raise ConfigError(f"{where}: {key!r} is {entry.get(key)!r}; a name is needed.")
    poses = [key for key in ("cam_to_world", "world_to_cam") if key in entry]
    if len(poses) != 1:
        raise ConfigError(f"{where}: give one of cam_to_world and world_to_cam: a feature's name, or a 4x4 matrix.")
    pose = entry[poses[0]]
    distortion = entry.get("distortion")
    if distortion is not None and (not isinstance(distortion, list) or len(distortion) not in (5, 8)):
        raise ConfigError(f"{where}: distortion is {distortion!r}; OpenCV's 5 or 8 numbers are needed.")
    return MappedView(
        name=entry["name"],
        rgb=entry["rgb"],
        depth=entry["depth"],
        intrinsics=_intrinsics(entry.get("intrinsics"), where),
        pose=pose if isinstance(pose, str) else checked_pose(pose, f"{where}: {poses[0]}"),
        is_world_to_cam=poses[0] == "world_to_cam",
        axes=choice(entry, "axes", where, _AXES),
        pixel_center=float(choice(entry, "pixel_center", where, _PIXEL_CENTERS)),
        depth_type=choice(entry, "depth_type", where, _DEPTH_TYPES),
        depth_unit=number(entry, "depth_unit", where) if "depth_unit" in entry else None,
        depth_codes={key: entry[key] for key in ("depth_range", "depth_log", "depth_shift") if key in entry},
        quaternion=choice(entry, "quaternion", where, _QUATERNIONS) if "quaternion" in entry else None,
        distortion=None if distortion is None else np.array(distortion, np.float64),
    )


def _intrinsics(value: Any, where: str) -> str | NDArray[np.float64]:
    if isinstance(value, str):
        return value
    if isinstance(value, dict):
        return checked_intrinsics(
            camera_matrix(*(number(value, key, f"{where}: intrinsics") for key in ("fx", "fy", "cx", "cy"))),
            f"{where}: intrinsics",
        )
    if value is None:
        raise ConfigError(f"{where}: intrinsics is missing: a feature's name, {{fx, fy, cx, cy}}, or a 3x3 matrix.")
    return checked_intrinsics(value, f"{where}: intrinsics")
