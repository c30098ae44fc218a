"""A scene whose depth is known in closed form (float64 NumPy): a floor, a back wall and turned boxes."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.schema import Trajectory

Array = NDArray[np.float64]
GL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Box:
    center: Array
    rotation: Array  # (3, 3), columns are the box's axes
    half_size: Array


def random_boxes(draw: np.random.Generator, count: int) -> list[Box]:
    boxes = []
    for _ in range(count):
        angle = draw.uniform(0, np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        half = draw.uniform(0.08, 0.3, size=3)
        boxes.append(Box(np.array([*draw.uniform(-0.5, 0.5, size=2), half[2]]), turn, half))
    return boxes


def look_at(position: Array, target: Array) -> Array:
    """Camera to world with OpenCV axes."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = position
    return pose


def pinhole(height: int, width: int, field_of_view: float) -> Array:
    """Vertical field of view in degrees; pixel centres at +0.5."""
    focal = 0.5 * height / np.tan(0.5 * np.radians(field_of_view))
    return np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1.0]])


def cast(boxes: list[Box], intrinsics: Array, pose: Array, height: int, width: int, wall: float = 1.5) -> Array:
    """Return z-depth (height, width) of the nearest of floor z = 0, wall y = ``wall``, and boxes; 0 for none."""
    v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    directions = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(intrinsics).T @ pose[:3, :3].T
    origin = pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = np.full((height, width), np.inf)
        for axis, level in ((2, 0.0), (1, wall)):
            depth = (level - origin[axis]) / directions[..., axis]
            nearest = np.where((depth > 0) & (depth < nearest), depth, nearest)
        for box in boxes:
            start, along = (origin - box.center) @ box.rotation, directions @ box.rotation
            first, second = (-box.half_size - start) / along, (box.half_size - start) / along
            enter, leave = np.minimum(first, second).max(axis=-1), np.maximum(first, second).min(axis=-1)
            nearest = np.where((enter <= leave) & (enter > 0) & (enter < nearest), enter, nearest)
    return np.where(np.isfinite(nearest), nearest, 0.0)


def known_trajectory(
    seed: int = 0,
    num_frames: int = 3,
    num_views: int = 3,
    height: int = 48,
    width: int = 64,
    field_of_view: float = 55.0,
    is_moving: bool = False,
    **changes: Any,
) -> Trajectory:
    """Two or three boxes on a floor; cameras about 2 m away in an arc, or one walking along that arc."""
    draw = np.random.default_rng([7, seed])
    boxes = random_boxes(draw, int(draw.integers(2, 4)))
    intrinsics = pinhole(height, width, field_of_view)
    count = num_frames * num_views if is_moving else num_views
    azimuths = np.radians(-90 + draw.uniform(20, 40) * (np.arange(count) - 0.5 * (count - 1)) / (1 if count < 5 else 2))
    poses = []
    for azimuth in azimuths:
        distance, up = draw.uniform(1.7, 2.3), draw.uniform(0.6, 1.3)
        position = np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), up])
        poses.append(look_at(position, np.append(draw.uniform(-0.15, 0.15, size=2), 0.1)))
    depth = np.stack([cast(boxes, intrinsics, pose, height, width) for pose in poses]).astype(np.float32)
    cam_to_world = np.stack(poses)
    if is_moving:
        depth = depth.reshape(num_frames, num_views, height, width)
        cam_to_world = cam_to_world.reshape(num_frames, num_views, 4, 4)
    else:
        depth = np.repeat(depth[None], num_frames, axis=0)
    values: dict[str, Any] = {
        "rgb": draw.integers(0, 256, size=(*depth.shape, 3), dtype=np.uint8),
        "depth": depth,
        "intrinsics": np.repeat(intrinsics[None], num_views, axis=0),
        "cam_to_world": cam_to_world,
        "frame_time": 0.05,
        "near": 0.3,
        "far": 12.0,
        "workspace_min": (-1.0, -1.0, -0.1),
        "workspace_max": (1.0, 1.0, 1.0),
        "seed": seed,
    }
    return Trajectory(**{**values, **changes})
