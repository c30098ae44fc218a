"""Nearest points of a closed triangle mesh, and the surface of a tetrahedral one. World frame, metres."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

Array = NDArray[np.float64]
_NUM_CANDIDATES = 16  # triangles with the nearest centres; the nearest triangle of a mesh of even size is among them


@dataclass(frozen=True)
class SurfacePoints:
    """Points of a surface: ``weights`` of the corners of a ``triangle``; ``distance`` (m) is to the query point."""

    triangle: Int64[np.ndarray, " point"]
    weights: Float64[np.ndarray, "point 3"]
    distance: Float64[np.ndarray, " point"]

    def of(self, chosen: NDArray[np.bool_]) -> "SurfacePoints":
        """Return those of some points."""
        return SurfacePoints(self.triangle[chosen], self.weights[chosen], self.distance[chosen])


def surface_of(tetrahedra: NDArray[np.integer]) -> Int64[np.ndarray, "triangle 3"]:
    """Faces that belong to one tetrahedron only, as indices of vertices."""
    faces = np.concatenate([np.delete(tetrahedra, corner, axis=1) for corner in range(4)])
    unique, counts = np.unique(np.sort(faces, axis=1), axis=0, return_counts=True)
    return unique[counts == 1].astype(np.int64)


def nearest_on_surface(points: Float64[np.ndarray, "point 3"], corners: Array) -> SurfacePoints:
    """Find the nearest point of a mesh (``corners``: triangle, 3, 3) for each point."""
    tree = cKDTree(corners.mean(axis=1))
    count = min(_NUM_CANDIDATES, len(corners))
    candidates = tree.query(points, k=count)[1].reshape(len(points), count)
    weights, distance = _nearest_on_triangle(points[:, None], corners[candidates])
    best = distance.argmin(axis=1)
    rows = np.arange(len(points))
    return SurfacePoints(candidates[rows, best].astype(np.int64), weights[rows, best], distance[rows, best])


def surface_errors(
    pred: Float[Tensor, "step particle 3"], surface: Float[Tensor, "step triangle 3 3"]
) -> Float[Tensor, " step"]:
    """Mean distance in metres from each step's points to the true surface of that step."""
    pairs = zip(pred.numpy(), surface.numpy(), strict=True)
    return torch.tensor([nearest_on_surface(points, corners).distance.mean() for points, corners in pairs])


def _nearest_on_triangle(points: Array, corners: Array) -> tuple[Array, Array]:
    """Return (weights of the corners, distance) of the nearest point of each triangle (..., 3 corners, 3).

    It is the foot of the perpendicular where that lies in the triangle, and else on one of its edges.
    """
    weights = [_foot(points, corners)]
    weights += [_on_edge(points, corners, start) for start in range(3)]
    tried = np.stack(weights)
    distance = np.linalg.norm(points - np.einsum("n...c,...ck->n...k", tried, corners), axis=-1)
    distance[0, (tried[0] < 0).any(axis=-1)] = np.inf
    best = distance.argmin(axis=0)[None]
    picked = np.take_along_axis(tried, best[..., None], axis=0)[0]
    return picked, np.take_along_axis(distance, best, axis=0)[0]


def _foot(points: Array, corners: Array) -> Array:
    first, second = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    offset = points - corners[..., 0, :]
    aa, ab, bb = ((x * y).sum(-1) for x, y in ((first, first), (first, second), (second, second)))
    pa, pb = (offset * first).sum(-1), (offset * second).sum(-1)
    scale = np.maximum(aa * bb - ab * ab, 1e-300)
    v, w = (bb * pa - ab * pb) / scale, (aa * pb - ab * pa) / scale
    return np.stack([1 - v - w, v, w], axis=-1)


def _on_edge(points: Array, corners: Array, start: int) -> Array:
    end = (start + 1) % 3
    edge = corners[..., end, :] - corners[..., start, :]
    along = ((points - corners[..., start, :]) * edge).sum(-1) / np.maximum((edge * edge).sum(-1), 1e-300)
    along = np.clip(along, 0.0, 1.0)
    weights = np.zeros((*along.shape, 3))
    weights[..., start], weights[..., end] = 1 - along, along
    return weights
