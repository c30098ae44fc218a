"""What ``cameras.json`` of a plain folder says of one view's cameras: intrinsics, poses, lens, and a depth sensor."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.conventions import (
    camera_matrix,
    checked_intrinsics,
    checked_pose,
    invert_pose,
    shift_principal_point,
)
from data_gen.importers.depth_registration import DepthCamera
from data_gen.importers.source_files import choice, number
from data_gen.settings import did_you_mean
from vpd_lightning.errors import DataError

PIXEL_CENTERS = {0.0: "OpenCV, ROS, RealSense", 0.5: "COLMAP, nerfstudio, most renderers"}
_DEPTH_CAMERA_KEYS = ("K", "fx", "fy", "cx", "cy", "distortion", "pixel_center", "depth_to_color")


def view_intrinsics(entry: Mapping[str, Any], where: str, num_frames: int) -> NDArray[np.float64]:
    """Return (3, 3), or (time, 3, 3) where the file lists one for each frame; pixel centres as the file counts them."""
    if "K" in entry:
        return _per_frame(entry["K"], num_frames, f"{where}: 'K'", checked_intrinsics)
    names = ("fx", "fy", "cx", "cy")
    lists = [entry[name] for name in names if isinstance(entry.get(name), list)]
    if not lists:
        matrix = camera_matrix(*(number(entry, name, where) for name in names))
        return checked_intrinsics(matrix, f"{where}: fx, fy, cx, cy")
    if any(len(values) != num_frames for values in lists):
        raise DataError(f"{where}: fx, fy, cx, cy have one entry each, or one per frame ({num_frames}).")
    rows = [
        {name: entry[name][i] if isinstance(entry.get(name), list) else entry.get(name) for name in names}
        for i in range(num_frames)
    ]
    return np.stack(
        [
            checked_intrinsics(
                camera_matrix(*(number(row, name, f"{where}, frame {i}") for name in names)), f"{where}, frame {i}"
            )
            for i, row in enumerate(rows)
        ]
    )


def view_poses(entry: Mapping[str, Any], where: str, num_frames: int) -> NDArray[np.float64]:
    """Return cam_to_world (4, 4), or (time, 4, 4) where the file lists one for each frame, in the view's own axes."""
    given = [name for name in ("cam_to_world", "world_to_cam") if name in entry]
    if len(given) != 1:
        raise DataError(f"{where}: give one of 'cam_to_world' and 'world_to_cam' (4x4, or one 4x4 per frame).")
    poses = _per_frame(entry[given[0]], num_frames, f"{where}: {given[0]!r}", checked_pose)
    return invert_pose(poses) if given[0] == "world_to_cam" else poses


def _per_frame(values: Any, num_frames: int, where: str, check: Any) -> NDArray[np.float64]:
    """Check one matrix, or a list with one matrix per frame; errors name the frame."""
    if _depth(values) <= 2:
        return check(values, where)
    if len(values) != num_frames:
        raise DataError(f"{where} has {len(values)} matrices; there are {num_frames} frames.")
    return np.stack([check(value, f"{where}, frame {index}") for index, value in enumerate(values)])


def _depth(values: Any) -> int:
    """Return how many lists lie in each other, up to 4."""
    depth = 0
    while isinstance(values, list) and values and depth < 4:
        values, depth = values[0], depth + 1
    return depth


def view_distortion(entry: Mapping[str, Any], where: str) -> NDArray[np.float64] | None:
    """Return OpenCV's 5 or 8 numbers, or None."""
    values = entry.get("distortion")
    if values is None:
        return None
    is_list = isinstance(values, list) and all(isinstance(x, int | float) for x in values)
    if not is_list or len(values) not in (4, 5, 8) or not np.isfinite(values).all():
        raise DataError(f"{where}: 'distortion' is {values!r}; OpenCV's k1 k2 p1 p2 k3 (4, 5 or 8 numbers) are needed.")
    return np.array([*values, 0.0] if len(values) == 4 else values, np.float64)


def depth_camera(
    entry: Mapping[str, Any], where: str, pixel_center: float, size: tuple[int, int]
) -> DepthCamera | None:
    """Return the sensor that took a view's depth, or None where depth is aligned to colour.

    Args:
        entry: the view, which may have a ``depth_camera``.
        where: says in errors which one it is.
        pixel_center: the view's, where the sensor has none of its own.
        size: (height, width) of the depth images.
    """
    given = entry.get("depth_camera")
    if given is None:
        return None
    where = f"{where}: depth_camera"
    if not isinstance(given, dict) or "depth_to_color" not in given:
        raise DataError(
            f"{where} must be an object with the sensor's intrinsics and 'depth_to_color', the 4x4 pose of the depth "
            "sensor in the colour camera's frame (x right, y down, z forward, metres)."
        )
    for key in given:
        if key not in _DEPTH_CAMERA_KEYS:
            hint = did_you_mean(str(key), _DEPTH_CAMERA_KEYS)
            raise DataError(f"{where}: unknown key {key!r}{hint}\nKeys: {', '.join(_DEPTH_CAMERA_KEYS)}.")
    if "pixel_center" in given:
        pixel_center = float(choice(given, "pixel_center", where, PIXEL_CENTERS))
    intrinsics = shift_principal_point(view_intrinsics(given, where, 1), 0.5 - pixel_center)
    if intrinsics.ndim != 2:
        raise DataError(f"{where}: a sensor whose intrinsics change is not supported; give one number each.")
    to_color = checked_pose(given["depth_to_color"], f"{where}: depth_to_color")
    return DepthCamera(*size, intrinsics, to_color, view_distortion(given, where))
