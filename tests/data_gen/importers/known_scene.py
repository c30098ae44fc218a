"""A scene known in closed form: a floor at z = 0 and a moving, turning box, ray-cast in float64.

Nothing here uses the package under test. Cameras have OpenCV axes, intrinsics have pixel centres at +0.5, metres.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HALF_SIZES = np.array([0.3, 0.2, 0.25])
FRAME_TIME = 0.05


@dataclass(frozen=True)
class Picture:
    """What one camera sees: colour, depth along the optical axis, distance to the camera centre (0 = nothing)."""

    rgb: NDArray[np.uint8]
    depth: Array
    distance: Array


def camera(azimuth: float, elevation: float, radius: float, height: int, width: int) -> tuple[Array, Array]:
    """Intrinsics (3, 3) and cam_to_world (4, 4) of a camera that looks at a point near the box; angles in degrees."""
    a, e = np.radians([azimuth, elevation])
    target = np.array([0.0, 0.0, 0.2])
    position = target + radius * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = position
    focal = 0.9 * width
    return np.array([[focal, 0, 0.48 * width], [0, focal * 1.01, 0.53 * height], [0, 0, 1]]), pose


def cameras(num_views: int = 3, height: int = 48, width: int = 64) -> tuple[Array, Array]:
    """Intrinsics (view, 3, 3) and cam_to_world (view, 4, 4) of cameras at different heights and distances."""
    both = [camera(70.0 * v + 10, 45.0 + 11 * (v % 3), 2.0 + 0.2 * (v % 4), height, width) for v in range(num_views)]
    return np.stack([k for k, _ in both]), np.stack([p for _, p in both])


def box_pose(time: float) -> Array:
    """Pose (4, 4) of the box at a time in seconds."""
    a, b = 0.4 + 1.5 * time, 0.3 + 0.8 * time
    turn_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    turn_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    pose = np.eye(4)
    pose[:3, :3] = turn_z @ turn_x
    pose[:3, 3] = [0.4 * time, -0.2 * time, 0.45]
    return pose


def distort(rays: Array, distortion: Array) -> Array:
    """OpenCV's model, forwards: undistorted (..., 2) x/z, y/z to distorted; k1 k2 p1 p2 k3 [k4 k5 k6]."""
    k1, k2, p1, p2, k3, *rest = distortion
    k4, k5, k6 = rest or (0.0, 0.0, 0.0)
    x, y = rays[..., 0], rays[..., 1]
    r = x * x + y * y
    radial = (1 + r * (k1 + r * (k2 + r * k3))) / (1 + r * (k4 + r * (k5 + r * k6)))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x),
            y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def render(
    intrinsics: Array, cam_to_world: Array, height: int, width: int, time: float, distortion: Array | None = None
) -> Picture:
    """Cast one ray through each pixel's centre (of the distorted image, where there is distortion)."""
    v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    seen = np.stack([(u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1]], axis=-1)
    rays = seen.copy()
    if distortion is not None:
        for _ in range(200):  # a contraction for mild lenses
            rays = rays + (seen - distort(rays, distortion))
        assert np.abs(distort(rays, distortion) - seen).max() < 1e-13
    in_camera = np.concatenate([rays, np.ones((height, width, 1))], axis=-1)  # one unit along the axis: t is z-depth
    directions = in_camera @ cam_to_world[:3, :3].T
    origin = cam_to_world[:3, 3]

    with np.errstate(divide="ignore", invalid="ignore"):
        floor = -origin[2] / directions[..., 2]
        floor = np.where(floor > 0, floor, np.inf)
        box = _box_hits(origin, directions, box_pose(time))
    depth = np.minimum(floor, box)
    hit = np.isfinite(depth)
    depth = np.where(hit, depth, 0.0)
    points = origin + depth[..., None] * directions
    rgb = np.where((box <= floor)[..., None], *_colors(points))
    rgb = np.where(hit[..., None], rgb, [120.0, 160.0, 220.0])
    return Picture(np.rint(rgb).astype(np.uint8), depth, depth * np.linalg.norm(in_camera, axis=-1))


def distance_to_surfaces(points: Array, time: float) -> Array:
    """Distances (...) of points (..., 3) to the nearest surface of the scene, unsigned."""
    pose = box_pose(time)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    outside = np.abs(local) - HALF_SIZES
    box = np.linalg.norm(np.maximum(outside, 0), axis=-1) + np.minimum(outside.max(axis=-1), 0)
    return np.minimum(np.abs(points[..., 2]), np.abs(box))


def unproject(depth: Array, intrinsics: Array, cam_to_world: Array) -> Array:
    """World points (n, 3) of the pixels of a z-depth image that have a depth."""
    height, width = depth.shape
    v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    z = np.asarray(depth, np.float64)
    x = (u - intrinsics[0, 2]) / intrinsics[0, 0] * z
    y = (v - intrinsics[1, 2]) / intrinsics[1, 1] * z
    return np.stack([x, y, z], axis=-1)[z > 0] @ cam_to_world[:3, :3].T + cam_to_world[:3, 3]


def _box_hits(origin: Array, directions: Array, pose: Array) -> Array:
    start = (origin - pose[:3, 3]) @ pose[:3, :3]
    along = directions @ pose[:3, :3]
    first, second = (-HALF_SIZES - start) / along, (HALF_SIZES - start) / along
    enter = np.minimum(first, second).max(axis=-1)
    leave = np.maximum(first, second).min(axis=-1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def _colors(points: Array) -> tuple[Array, Array]:
    wave = np.sin(5 * points[..., :1]) * np.sin(5 * points[..., 1:2])
    return np.array([200.0, 70.0, 50.0]) + 30 * wave, np.array([110.0, 115.0, 105.0]) + 40 * wave
