"""Closed meshes from grids: revolutions, tubes, prisms, boxes of voxels."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data_gen.movi.mesh import Mesh
from data_gen.movi.signed_distance import split_quads


def grid_mesh(points: NDArray[np.float64], texture_rows: NDArray[np.float64] | None = None) -> Mesh:
    """Mesh a grid of points (row, column, 3) that closes in its columns; rows that shrink to a point are poles.

    Seen from outside, columns run to the right and rows upwards. The first and the last row must be poles (or the
    grid is open there). Texture coordinates: u along the columns (the seam's vertices stand there twice), v along
    ``texture_rows`` (row,), which is the row's share of the mean way along the rows where it is not given.
    """
    rows, columns = points.shape[:2]
    if texture_rows is None:
        steps = np.linalg.norm(np.diff(points, axis=0), axis=-1).mean(axis=1)
        texture_rows = np.concatenate([[0.0], np.cumsum(steps) / max(float(steps.sum()), 1e-12)])
    vertices = np.concatenate([points, points[:, :1]], axis=1).reshape(-1, 3)
    u, v = np.meshgrid(np.arange(columns + 1) / columns, texture_rows)
    start = np.arange(rows - 1)[:, None] * (columns + 1) + np.arange(columns)
    quads = np.stack([start, start + 1, start + columns + 2, start + columns + 1], axis=-1).reshape(-1, 4)
    texcoords = np.stack([u, v], axis=-1).reshape(-1, 2)
    return Mesh(vertices, split_quads(vertices, quads), texcoords).without_slivers()


def revolution(profile: ArrayLike, sections: int) -> Mesh:
    """Turn a profile (point, 2) of radius and height around z; it starts and ends on the axis, outer side upwards."""
    radius, height = np.asarray(profile, dtype=np.float64).T
    angle = 2 * np.pi * np.arange(sections) / sections
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(sections)], axis=-1)
    return grid_mesh(radius[:, None, None] * circle + height[:, None, None] * [0.0, 0.0, 1.0])


def tube(path: NDArray[np.float64], radius: float, sections: int) -> Mesh:
    """Sweep a circle along a closed path (point, 3); its frame is turned evenly so that the ends meet."""
    count = len(path)
    tangent = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.zeros_like(path)
    start = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    normal[0] = start / np.linalg.norm(start)
    for i in range(1, count):  # carried along, losing what is not across the path
        across = normal[i - 1] - (normal[i - 1] @ tangent[i]) * tangent[i]
        normal[i] = across / np.linalg.norm(across)
    final = normal[-1] - (normal[-1] @ tangent[0]) * tangent[0]
    twist = np.arctan2(np.cross(normal[0], final) @ tangent[0], normal[0] @ final)
    angle = 2 * np.pi * np.arange(sections) / sections - twist * np.arange(count)[:, None] / count
    binormal = np.cross(tangent, normal)
    points = path[:, None] + radius * (
        np.cos(angle)[..., None] * normal[:, None] + np.sin(angle)[..., None] * binormal[:, None]
    )
    here, left = np.arange(count)[:, None] * sections, np.arange(sections)
    ahead, right = np.roll(here, -1, axis=0), np.roll(left, -1)
    corners = [here + left, here + right, ahead + right, ahead + left]
    quads = np.stack(corners, axis=-1).reshape(-1, 4)
    vertices = points.reshape(-1, 3)
    return Mesh(vertices, split_quads(vertices, quads))


def pierced_prism(outline: NDArray[np.float64], hole: NDArray[np.float64], height: float) -> Mesh:
    """A prism along z over an outline (point, 2) with a hole (as many points, 2); both counter-clockwise."""
    count = len(outline)
    flat = np.concatenate([outline, hole])
    low = np.column_stack([flat, np.full(2 * count, -height / 2)])
    vertices = np.concatenate([low, low + [0.0, 0.0, height]])
    i = np.arange(count)
    n = (i + 1) % count
    outer_low, hole_low, outer_high, hole_high = 0, count, 2 * count, 3 * count
    quads = np.concatenate(
        [
            np.stack([outer_low + i, outer_low + n, outer_high + n, outer_high + i], axis=1),
            np.stack([hole_low + n, hole_low + i, hole_high + i, hole_high + n], axis=1),
            np.stack([outer_high + i, outer_high + n, hole_high + n, hole_high + i], axis=1),
            np.stack([outer_low + n, outer_low + i, hole_low + i, hole_low + n], axis=1),
        ]
    )
    return Mesh(vertices, split_quads(vertices, quads))


def voxel_mesh(filled: NDArray[np.bool_]) -> Mesh:
    """The border of filled unit cells (x, y, z), two triangles for each cell face that is free."""
    padded = np.pad(filled, 1)
    quads = []
    for axis in range(3):
        others = [(axis + 1) % 3, (axis + 2) % 3]
        for side in (0, 1):
            free = padded & ~np.roll(padded, 1 - 2 * side, axis=axis)
            corner = np.repeat(np.argwhere(free)[:, None], 4, axis=1) - 1
            corner[:, :, axis] += side
            for k, (a, b) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
                corner[:, k, others[0]] += a
                corner[:, k, others[1]] += b
            quads.append(corner if side else corner[:, ::-1])
    corners = np.concatenate(quads)
    points, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    vertices = points.astype(np.float64)
    return Mesh(vertices, split_quads(vertices, np.asarray(index).reshape(-1, 4)))
