"""What people get wrong when they convert recordings: each function takes a correct trajectory to a wrong one."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tests.data.analytic_scene import GL
from vpd_lightning.data.schema import Trajectory

Change = Callable[[Trajectory], Trajectory]


def chain(*changes: Change) -> Change:
    def apply(trajectory: Trajectory) -> Trajectory:
        for change in changes:
            trajectory = change(trajectory)
        return trajectory

    return apply


def opengl(trajectory: Trajectory) -> Trajectory:
    return replace(trajectory, cam_to_world=trajectory.cam_to_world @ GL)


def inverted(trajectory: Trajectory) -> Trajectory:
    return replace(trajectory, cam_to_world=np.linalg.inv(trajectory.cam_to_world))


def turned_back(trajectory: Trajectory) -> Trajectory:
    poses = trajectory.cam_to_world.copy()
    poses[..., :3, :3] = np.swapaxes(trajectory.cam_to_world[..., :3, :3], -1, -2)
    return replace(trajectory, cam_to_world=poses)


def positions_in_millimetres(trajectory: Trajectory) -> Trajectory:
    poses = trajectory.cam_to_world.copy()
    poses[..., :3, 3] *= 1000
    return replace(trajectory, cam_to_world=poses)


def ray_lengths(trajectory: Trajectory) -> np.ndarray:
    """Length of each pixel's ray per unit of z, (view, height, width) or with time before."""
    height, width = trajectory.depth.shape[2:]
    matrix = trajectory.intrinsics[..., None, None]
    x = (np.arange(width) + 0.5 - matrix[..., 0, 2, :, :]) / matrix[..., 0, 0, :, :]
    y = (np.arange(height)[:, None] + 0.5 - matrix[..., 1, 2, :, :]) / matrix[..., 1, 1, :, :]
    return np.sqrt(1 + x**2 + y**2).astype(np.float32)


def as_distance(trajectory: Trajectory) -> Trajectory:
    return replace(trajectory, depth=trajectory.depth * ray_lengths(trajectory))


def converted_twice(trajectory: Trajectory) -> Trajectory:
    return replace(trajectory, depth=trajectory.depth / ray_lengths(trajectory))


def scaled(factor: float) -> Change:
    return lambda trajectory: replace(trajectory, depth=trajectory.depth * np.float32(factor))


def shifted(pixels: float) -> Change:
    def apply(trajectory: Trajectory) -> Trajectory:
        intrinsics = trajectory.intrinsics.copy()
        intrinsics[..., :2, 2] += pixels
        return replace(trajectory, intrinsics=intrinsics)

    return apply


def noisy(trajectory: Trajectory) -> Trajectory:
    """One per cent of the depth, independent in every pixel."""
    noise = np.random.default_rng([1, trajectory.seed]).standard_normal(trajectory.depth.shape)
    return replace(trajectory, depth=(trajectory.depth * (1 + 0.01 * noise)).astype(np.float32))


def whole_millimetres(trajectory: Trajectory) -> Trajectory:
    return replace(trajectory, depth=(np.round(trajectory.depth * 1000) / 1000).astype(np.float32))


def with_holes(trajectory: Trajectory) -> Trajectory:
    is_hole = np.random.default_rng([2, trajectory.seed]).random(trajectory.depth.shape) < 0.3
    return replace(trajectory, depth=np.where(is_hole, 0, trajectory.depth).astype(np.float32))
