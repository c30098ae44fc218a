"""Cameras on an upper half sphere: centres, poses and intrinsics in our conventions, and as MJCF."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from data_gen.scene_settings import CameraSettings

GL_TO_CV = np.diag([1.0, -1.0, -1.0])  # between OpenGL (x right, y up, z back) and OpenCV (x right, y down, z forward)


def camera_positions(settings: CameraSettings) -> NDArray[np.float64]:
    """Return camera centres (view, 3): a golden-angle spiral, even in area between the two elevations."""
    index = np.arange(settings.num_views) + 0.5
    low, high = np.sin(np.radians([settings.elevation_min, settings.elevation_max]))
    z = low + (high - low) * index / settings.num_views
    azimuth = index * math.pi * (3.0 - math.sqrt(5.0))
    if settings.num_views <= 8:  # few cameras: even in azimuth, elevations alternating
        azimuth = index * 2 * math.pi / settings.num_views
        z = low + (high - low) * ((index * 0.618034) % 1.0)
    flat = np.sqrt(1 - z * z)
    directions = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], axis=1)
    return np.asarray(settings.target) + settings.radius * directions


def camera_poses(settings: CameraSettings) -> NDArray[np.float64]:
    """Return cam_to_world (view, 4, 4), OpenCV axes: z towards the target, x level."""
    poses = np.tile(np.eye(4), (settings.num_views, 1, 1))
    for pose, eye in zip(poses, camera_positions(settings), strict=True):
        forward = np.asarray(settings.target) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = eye
    return poses


def camera_intrinsics(settings: CameraSettings) -> NDArray[np.float64]:
    """Return intrinsics (view, 3, 3) in pixels: square pixels, centred, pixel centres at +0.5."""
    focal = 0.5 * settings.height / math.tan(math.radians(settings.field_of_view) / 2)
    matrix = np.array([[focal, 0, settings.width / 2], [0, focal, settings.height / 2], [0, 0, 1.0]])
    return np.tile(matrix, (settings.num_views, 1, 1))


def camera_xml(settings: CameraSettings) -> str:
    """Return the MJCF elements of all cameras, named ``view0``, ``view1``, ...; put them into the world body."""
    elements = []
    for view, pose in enumerate(camera_poses(settings)):
        axes = pose[:3, :3] @ GL_TO_CV
        elements.append(
            f'<camera name="view{view}" pos="{mjcf_numbers(pose[:3, 3])}" fovy="{settings.field_of_view!r}"'
            f' xyaxes="{mjcf_numbers(np.concatenate([axes[:, 0], axes[:, 1]]))}"/>'
        )
    return "".join(elements)


def mjcf_numbers(values: Sequence[float] | NDArray[np.float64]) -> str:
    """Return numbers as MJCF wants them, with all their digits."""
    return " ".join(repr(float(value)) for value in values)
