"""Camera paths as nerfstudio's viewer writes them in its render tab, and as ``ns-render camera-path`` reads them."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.camera_checks import check_intrinsics, check_poses
from vpd_lightning.errors import ConfigError, DataError
from vpd_lightning.files import AtomicPath
from vpd_lightning.types import Cameras

_FLIP = np.array([1.0, -1.0, -1.0, 1.0])
"""Between OpenGL's camera axes (x right, y up, z back) and OpenCV's (x right, y down, z forward), both ways."""

_OFF_CENTER = 0.01  # pixels; a file has no principal point, so what is farther off cannot be written
_UNEVEN = 1e-4  # relative difference of the focal lengths

_EXPECTED = (
    'Expected: {"camera_type": "perspective", "render_height": 128, "render_width": 128, "camera_path": '
    '[{"camera_to_world": 16 numbers, "fov": 50.0}, ...]}.'
)


def is_camera_path(content: Any) -> bool:
    """Tell whether parsed JSON is a camera path of nerfstudio."""
    return isinstance(content, Mapping) and "camera_path" in content


def parse_camera_path(
    path: Path, content: Mapping[str, Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64], int, int]:
    """Return intrinsics (camera, 3, 3) in pixels, poses (camera, 4, 4) with OpenCV axes, height and width.

    ``camera_to_world`` is row by row, with OpenGL's camera axes, in the coordinates of the recording (metres). ``fov``
    is the vertical angle in degrees; pixels are square and the optical axis goes through the middle of the image, so
    ``aspect`` is not read (nor does nerfstudio; Blender's add-on always writes 1). ``path`` is for messages.

    Raises:
        DataError: it is not such a path, or its cameras are no perspective cameras.
    """
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise DataError(f"{path} has {kind!r} cameras.\nOnly camera_type perspective can be rendered.")
    try:
        height, width = content["render_height"], content["render_width"]
        cameras = list(content["camera_path"])
        flat = np.array([camera["camera_to_world"] for camera in cameras], dtype=np.float64)
        fov = np.array([camera["fov"] for camera in cameras], dtype=np.float64)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise DataError(f"{path} is not a camera path: {type(error).__name__} {error}.\n{_EXPECTED}") from error
    if not all(isinstance(side, int) and not isinstance(side, bool) and side >= 1 for side in (height, width)):
        raise DataError(f"{path} is for images of {height!r}x{width!r} pixels.\n{_EXPECTED}")
    if not cameras or flat.size != 16 * len(cameras) or fov.shape != (len(cameras),):
        raise DataError(f"{path} has {len(cameras)} cameras with matrices of shape {flat.shape[1:]}.\n{_EXPECTED}")
    wrong = [angle for angle in fov.tolist() if not 0 < angle < 180]
    if wrong:
        raise DataError(f"{path} has a field of view of {wrong[0]} degrees.\nAllowed: above 0, below 180.")
    intrinsics = np.zeros((len(cameras), 3, 3))
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = height / 2 / np.tan(np.radians(fov) / 2)
    intrinsics[:, 0, 2], intrinsics[:, 1, 2], intrinsics[:, 2, 2] = width / 2, height / 2, 1.0
    check_intrinsics(path, intrinsics, height, width)
    return intrinsics, check_poses(path, flat.reshape(-1, 4, 4)) * _FLIP, height, width


def write_camera_path(path: Path, cameras: Cameras, frames_per_second: float, is_cycle: bool) -> None:
    """Write cameras (axis ``camera``) as a path that nerfstudio renders and Blender's add-on of it reads.

    Raises:
        ConfigError: the cameras have what the format has not: another middle, or pixels that are not square.
    """
    intrinsics = cameras.intrinsics.double().cpu().numpy()
    poses = cameras.cam_to_world.double().cpu().numpy() * _FLIP
    fx, fy = intrinsics[:, 0, 0], intrinsics[:, 1, 1]
    middle = np.array([cameras.width, cameras.height]) / 2
    off = np.abs(intrinsics[:, :2, 2] - middle).max()
    if off > _OFF_CENTER or np.abs(fx / fy - 1).max() > _UNEVEN or np.abs(intrinsics[:, 0, 1]).max() > _OFF_CENTER:
        raise ConfigError(
            f"These cameras cannot be written as a camera path: their optical axes pass {off:.2f} pixels beside the "
            f"middle of the image, with focal lengths of {fx[0]:.2f} and {fy[0]:.2f} pixels.\n"
            "The format knows one vertical angle only. Use save_camera_path=false, or a camera file of your own."
        )
    angles = [math.degrees(2 * math.atan(cameras.height / 2 / focal)) for focal in fy]
    aspect = cameras.width / cameras.height
    content = {
        "camera_type": "perspective",
        "render_height": cameras.height,
        "render_width": cameras.width,
        "camera_path": [
            {"camera_to_world": pose.reshape(-1).tolist(), "fov": angle, "aspect": aspect}
            for pose, angle in zip(poses, angles, strict=True)
        ],
        "keyframes": [],
        "fps": frames_per_second,
        "seconds": len(poses) / frames_per_second,
        "smoothness_value": 0.0,
        "is_cycle": is_cycle,
    }
    with AtomicPath(path) as partial:
        partial.write_text(json.dumps(content, indent=1) + "\n")
