"""What depth images are measured against, in float64: closed-form distances to triangles, and other views."""

import numpy as np


def distance_to_triangles(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Distance (point,) in m from points (point, 3) to the nearest of triangles (triangle, 3 corners, 3)."""
    best = np.full(len(points), np.inf)
    for corners in triangles:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        is_beside = np.zeros(len(points), bool)
        for i in range(3):
            start, end = corners[i], corners[(i + 1) % 3]
            edge = end - start
            along = np.clip((points - start) @ edge / (edge @ edge), 0, 1)
            best = np.minimum(best, np.linalg.norm(points - start - along[:, None] * edge, axis=1))
            is_beside |= (points - start) @ np.cross(normal, edge) < 0
        height = np.abs((points - corners[0]) @ normal) / np.linalg.norm(normal)
        best = np.where(is_beside, best, np.minimum(best, height))
    return best


def unproject(depth: np.ndarray, intrinsics: np.ndarray, cam_to_world: np.ndarray) -> np.ndarray:
    """World points (height, width, 3) of one z-depth image; pixel centres at +0.5, OpenCV axes."""
    row, column = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    rays = np.stack([column, row, np.ones_like(row)], -1) @ np.linalg.inv(intrinsics).T
    points: np.ndarray = (rays * depth.astype(np.float64)[..., None]) @ cam_to_world[:3, :3].T + cam_to_world[:3, 3]
    return points


def free_space_violations(
    depth: np.ndarray, intrinsics: np.ndarray, cam_to_world: np.ndarray, tolerance: float
) -> tuple[int, int]:
    """Count points of one view that lie in space through which another view looked, and the points compared.

    Args:
        depth: (view, height, width) z-depth in m, 0 = none.
        intrinsics: (view, 3, 3).
        cam_to_world: (view, 4, 4).
        tolerance: m; a point counts when it is nearer to the other camera, along its axis, than the smallest of the
            3 x 3 measured depths around its pixel minus this.
    """
    violations = compared = 0
    for first in range(len(depth)):
        points = unproject(depth[first], intrinsics[first], cam_to_world[first])[depth[first] > 0]
        for second in range(len(depth)):
            if second == first:
                continue
            world_to_cam = np.linalg.inv(cam_to_world[second])
            seen = points @ world_to_cam[:3, :3].T + world_to_cam[:3, 3]
            pixels = seen @ intrinsics[second].T
            column, row = np.floor(pixels[:, :2] / pixels[:, 2:]).astype(int).T
            height, width = depth[second].shape
            inside = (seen[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
            padded = np.pad(np.where(depth[second] > 0, depth[second], np.inf), 1, constant_values=np.inf)
            smallest = np.min([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)], axis=0)
            measured = smallest[row[inside], column[inside]]
            known = np.isfinite(measured)
            compared += int(known.sum())
            violations += int((seen[inside, 2][known] < measured[known] - tolerance).sum())
    return violations, compared
