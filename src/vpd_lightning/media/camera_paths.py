"""Cameras that no recording has: a ring around the scene, or those of a file."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.data.reader import check_intrinsics, check_poses
from vpd_lightning.errors import ConfigError, DataError
from vpd_lightning.media.nerfstudio_paths import is_camera_path, parse_camera_path
from vpd_lightning.types import Cameras

_MAX_CAMERAS = 100_000
_MAX_SIDE = 16384


def look_at(eye: Float[Tensor, "camera 3"], target: Float[Tensor, " 3"]) -> Float[Tensor, "camera 4 4"]:
    """Poses of cameras at ``eye`` that look at ``target`` with the horizon level (OpenCV axes, world z up)."""
    forward = torch.nn.functional.normalize(target - eye, dim=-1)
    up = torch.zeros_like(forward)
    up[:, 2] = 1.0
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=-1)
    poses = torch.eye(4, dtype=eye.dtype).repeat(len(eye), 1, 1)
    poses[:, :3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=-1)
    poses[:, :3, 3] = eye
    return poses


def common_target(cameras: Cameras, fallback: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """The point closest to the optical axes of all cameras; ``fallback`` decides what the axes leave open."""
    axes, eyes = cameras.cam_to_world[:, :3, 2].double(), cameras.cam_to_world[:, :3, 3].double()
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    weak = 1e-3 * torch.eye(3, dtype=torch.float64)
    right_side = (across @ eyes[:, :, None]).sum(0).squeeze(-1) + weak @ fallback.double()
    return torch.linalg.solve(across.sum(0) + weak, right_side).to(cameras.cam_to_world.dtype)


def ring_cameras(cameras: Cameras, count: int, target: Float[Tensor, " 3"]) -> Cameras:
    """Return ``count`` cameras evenly on a circle around ``target``, at the recorded cameras' mean distance and height.

    The first stands at the azimuth of the first recorded camera, whose intrinsics all of them have.
    """
    eyes = cameras.cam_to_world[:, :3, 3]
    offset = eyes - target
    radius = offset[:, :2].norm(dim=-1).mean()
    start = math.atan2(float(offset[0, 1]), float(offset[0, 0]))
    angle = start + 2 * math.pi * torch.arange(count, dtype=eyes.dtype) / count
    height = eyes[:, 2].mean().expand(count)
    ring = torch.stack([target[0] + radius * angle.cos(), target[1] + radius * angle.sin(), height], dim=-1)
    return Cameras(cameras.intrinsics[:1].expand(count, 3, 3), look_at(ring, target), cameras.height, cameras.width)


def resized(cameras: Cameras, height: int | None, width: int | None) -> Cameras:
    """Return the same views at another image size (pixels); the focal lengths follow."""
    height, width = height or cameras.height, width or cameras.width
    if not (1 <= height <= _MAX_SIDE and 1 <= width <= _MAX_SIDE):
        raise ConfigError(f"The image size {height}x{width} is out of range.\nAllowed: 1 to {_MAX_SIDE} pixels a side.")
    scale = torch.tensor([width / cameras.width, height / cameras.height, 1.0], dtype=cameras.intrinsics.dtype)
    return Cameras(cameras.intrinsics * scale[:, None], cameras.cam_to_world, height, width)


def read_camera_file(path: Path) -> tuple[Cameras, bool]:
    """Read cameras from JSON, and whether they are the poses of one moving camera.

    ``{"height": H, "width": W, "moving": false, "cameras": [{"intrinsics": 3x3 pixels, "cam_to_world": 4x4 metres}]}``,
    or a camera path of nerfstudio (see ``nerfstudio_paths``), whose camera always moves.

    Raises:
        DataError: the file is missing or is neither.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(f"There is no camera file {path}.\nGive input, all, ring, [0,5] or a JSON file.") from None
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path} is not a camera file: {type(error).__name__} {error}.\n{_EXPECTED}") from error
    from_nerfstudio = is_camera_path(content)
    parse = parse_camera_path if from_nerfstudio else _parse_own
    intrinsics, poses, height, width = parse(path, content)
    if max(height, width) > _MAX_SIDE or len(poses) > _MAX_CAMERAS:
        raise DataError(
            f"{path} has {len(poses)} cameras of {height}x{width} pixels.\n"
            f"Allowed: {_MAX_CAMERAS} cameras, {_MAX_SIDE} pixels a side."
        )
    cameras = Cameras(_float32(intrinsics), _float32(poses), height, width)
    return cameras, from_nerfstudio or bool(content.get("moving", False))


def _parse_own(path: Path, content: Any) -> tuple[NDArray[np.float64], NDArray[np.float64], int, int]:
    try:
        cameras = content["cameras"]
        height, width = content["height"], content["width"]
        intrinsics = np.array([camera["intrinsics"] for camera in cameras], dtype=np.float64)
        poses = np.array([camera["cam_to_world"] for camera in cameras], dtype=np.float64)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise DataError(f"{path} is not a camera file: {type(error).__name__} {error}.\n{_EXPECTED}") from error
    if not all(isinstance(side, int) and side >= 1 for side in (height, width)) or not cameras:
        raise DataError(f"{path} has {len(cameras)} cameras of {height!r}x{width!r} pixels.\n{_EXPECTED}")
    if intrinsics.shape[1:] != (3, 3) or poses.shape[1:] != (4, 4):
        raise DataError(f"{path} has matrices of shapes {intrinsics.shape[1:]}, {poses.shape[1:]}.\n{_EXPECTED}")
    check_intrinsics(path, intrinsics, height, width)
    check_poses(path, poses)
    return intrinsics, poses, height, width


_EXPECTED = (
    'Expected: {"height": 128, "width": 128, "cameras": [{"intrinsics": 3x3, "cam_to_world": 4x4}, ...]}, '
    'or a camera path of nerfstudio ("camera_path": [...]).'
)


def _float32(array: np.ndarray) -> Tensor:
    return torch.from_numpy(array.astype(np.float32))
