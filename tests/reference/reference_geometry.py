"""Pinhole geometry written out pixel by pixel in float64 (paper section 3.1; conventions: OpenCV axes, z-depth).

Shares no code with the package and takes no shortcut: no matrix inverse, no broadcasting.
"""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def _camera_ray(intrinsics: Array, pixel_x: float, pixel_y: float) -> tuple[float, float, float]:
    """Solve ``intrinsics @ (x, y, 1) = (pixel_x, pixel_y, 1)`` by back substitution."""
    y = (pixel_y - float(intrinsics[1, 2])) / float(intrinsics[1, 1])
    x = (pixel_x - float(intrinsics[0, 2]) - float(intrinsics[0, 1]) * y) / float(intrinsics[0, 0])
    return x, y, 1.0


def _rotate(cam_to_world: Array, vector: tuple[float, float, float]) -> list[float]:
    return [sum(float(cam_to_world[row, column]) * vector[column] for column in range(3)) for row in range(3)]


def unproject(depth: Array, intrinsics: Array, cam_to_world: Array) -> Array:
    """World point of every pixel centre of one image; ``depth`` is the distance along the optical axis."""
    height, width = depth.shape
    points = np.zeros((height, width, 3))
    for row in range(height):
        for column in range(width):
            x, y, z = _camera_ray(intrinsics, column + 0.5, row + 0.5)
            distance = float(depth[row, column])
            rotated = _rotate(cam_to_world, (x * distance, y * distance, z * distance))
            for axis in range(3):
                points[row, column, axis] = rotated[axis] + float(cam_to_world[axis, 3])
    return points


def project(points: Array, intrinsics: Array, cam_to_world: Array) -> tuple[Array, Array]:
    """Pixel coordinates and z-depth of world points (point 3); the pose is rigid, so its inverse is a transpose."""
    pixels, depths = np.zeros((len(points), 2)), np.zeros(len(points))
    for number, point in enumerate(points):
        offset = [float(point[axis]) - float(cam_to_world[axis, 3]) for axis in range(3)]
        x, y, z = (sum(float(cam_to_world[row, column]) * offset[row] for row in range(3)) for column in range(3))
        pixels[number, 0] = (float(intrinsics[0, 0]) * x + float(intrinsics[0, 1]) * y) / z + float(intrinsics[0, 2])
        pixels[number, 1] = float(intrinsics[1, 1]) * y / z + float(intrinsics[1, 2])
        depths[number] = z
    return pixels, depths


def pixel_rays(intrinsics: Array, cam_to_world: Array, height: int, width: int) -> tuple[Array, Array]:
    """Origin and unit direction of the ray through every pixel centre."""
    origins, directions = np.zeros((height, width, 3)), np.zeros((height, width, 3))
    for row in range(height):
        for column in range(width):
            rotated = _rotate(cam_to_world, _camera_ray(intrinsics, column + 0.5, row + 0.5))
            length = math.sqrt(sum(value * value for value in rotated))
            for axis in range(3):
                origins[row, column, axis] = float(cam_to_world[axis, 3])
                directions[row, column, axis] = rotated[axis] / length
    return origins, directions
