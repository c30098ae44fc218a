"""Kubric's camera and depth, as its output folders and the MOVi records made from them describe them.

The camera looks along -z with y up (OpenGL), quaternions are w x y z and turn camera into world. Pixels are square, the
principal point is the image's middle with pixel centres at +0.5, and the depth layer holds the distance to the camera's
centre (``PerspectiveCamera`` and ``z_to_depth`` in Kubric's ``core/cameras.py``).
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.conventions import (
    camera_matrix,
    checked_intrinsics,
    checked_pose,
    distance_to_z,
    opengl_to_opencv,
    pose_matrix,
    rotation_from_quaternion,
    shift_principal_point,
)
from data_gen.importers.settings import ImportSettings, chosen
from vpd_lightning.errors import DataError

BACKGROUND = 1e9  # m; where no surface is, Blender's depth layer holds about 1e10
FRAME_RATE = 12.0  # per second, of all MOVi sets; records do not hold it
_UNIT_TOLERANCE = 1e-3  # of a quaternion's length


def kubric_intrinsics(
    camera: Mapping[str, Any], height: int, width: int, settings: ImportSettings, where: str
) -> NDArray[np.float64]:
    """Return (3, 3) from ``focal_length`` and ``sensor_width`` (mm), or the horizontal ``field_of_view`` (radians).

    Raises:
        DataError: neither is given, or they make no camera.
    """
    if "focal_length" in camera and "sensor_width" in camera:
        focal = _number(camera, "focal_length", where) / _number(camera, "sensor_width", where) * width
    elif "field_of_view" in camera:
        focal = width / 2 / np.tan(_number(camera, "field_of_view", where) / 2)
    else:
        raise DataError(f"{where} has neither focal_length with sensor_width nor field_of_view.")
    intrinsics = checked_intrinsics(camera_matrix(focal, focal, width / 2, height / 2), f"{where}: the focal length")
    return shift_principal_point(intrinsics, 0.5) if settings.pixel_center == "0.0" else intrinsics


def kubric_poses(
    camera: Mapping[str, Any], num_frames: int, settings: ImportSettings, where: str
) -> NDArray[np.float64]:
    """Return (time, 4, 4), or (4, 4) where the camera stands still, from ``positions`` and ``quaternions``.

    Raises:
        DataError: they are missing, of another number than the frames, or no rotations.
    """
    positions = _values(camera, "positions", 3, num_frames, where)
    quaternions = _values(camera, "quaternions", 4, num_frames, where)
    lengths = np.linalg.norm(quaternions, axis=-1)
    if np.abs(lengths - 1).max() > _UNIT_TOLERANCE:
        frame = int(np.argmax(np.abs(lengths - 1)))
        raise DataError(f"{where}, frame {frame}: the quaternion has length {lengths[frame]:.4g} instead of 1.")
    poses = pose_matrix(rotation_from_quaternion(quaternions), positions)
    if chosen(settings.axes, "opengl") == "opengl":
        poses = opengl_to_opencv(poses)
    poses = np.stack([checked_pose(pose, f"{where}, frame {frame}") for frame, pose in enumerate(poses)])
    return poses[0] if (poses == poses[0]).all() else poses


def kubric_depth(depth: NDArray[Any], intrinsics: NDArray[np.float64], settings: ImportSettings) -> NDArray[np.float32]:
    """Turn a depth layer in metres (height, width) into z-depth; background becomes 0."""
    metres = np.where(np.isfinite(depth) & (depth > 0) & (depth < BACKGROUND), depth, 0)
    if settings.depth_scale is not None:
        metres = metres * settings.depth_scale
    if chosen(settings.depth, "distance") == "distance":
        return distance_to_z(metres, intrinsics)
    return metres.astype(np.float32)


def kubric_source(format_name: str, settings: ImportSettings) -> dict[str, str]:
    """Return what a recording says of its source."""
    return {
        "format": format_name,
        "axes": chosen(settings.axes, "opengl"),
        "depth_type": chosen(settings.depth, "distance"),
        "depth_unit": str(settings.depth_scale or 1.0),
        "pixel_center": chosen(settings.pixel_center, "0.5"),
    }


def _number(camera: Mapping[str, Any], name: str, where: str) -> float:
    try:
        value = float(np.asarray(camera[name], np.float64).reshape(()))
    except (TypeError, ValueError) as error:
        raise DataError(f"{where}: {name} is not a number.") from error
    if not 0 < value < float("inf"):
        raise DataError(f"{where}: {name} is {value}; it must be above 0.")
    return value


def _values(camera: Mapping[str, Any], name: str, size: int, num_frames: int, where: str) -> NDArray[np.float64]:
    """Return (time, size); one row stands for all frames."""
    if name not in camera:
        raise DataError(f"{where} has no {name}: the camera's pose is unknown.")
    try:
        values = np.asarray(camera[name], np.float64).reshape(-1, size)
    except (TypeError, ValueError) as error:
        raise DataError(f"{where}: {name} are not rows of {size} numbers.") from error
    if len(values) == 1:
        values = np.repeat(values, num_frames, axis=0)
    if len(values) != num_frames:
        raise DataError(f"{where}: {len(values)} {name} for {num_frames} frames.")
    if not np.isfinite(values).all():
        raise DataError(f"{where}: {name} hold NaN or infinity.")
    return values
