"""Fewer faces: vertices that share a cell of a grid become one, separately for each patch of the texture."""

import numpy as np
from numpy.typing import NDArray

from data_gen.movi.mesh import Mesh


def reduced(mesh: Mesh, max_faces: int) -> Mesh:
    """Return ``mesh`` with at most ``max_faces`` faces (itself where it has no more already).

    Vertices in the same cell move to their mean, so that the surface stays without gaps; texture coordinates are
    averaged within a patch of connected texture only, so that colours do not bleed across seams. Normals are dropped.
    """
    cell = np.sqrt(2.0 * mesh.area / max_faces)
    result = mesh
    while len(result.faces) > max_faces:
        result = _clustered(mesh, cell)
        cell *= 1.1
    return result


def _clustered(mesh: Mesh, cell: float) -> Mesh:
    place = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.int64)
    _, block = np.unique(place, axis=0, return_inverse=True)
    block = np.asarray(block).reshape(-1)
    keys = np.stack([block, _patches(mesh)], axis=1)
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    number = np.asarray(number).reshape(-1)
    vertices = _means(mesh.vertices, block)[block[first]]
    faces = number[mesh.faces].astype(np.int32)
    texcoords = None if mesh.texcoords is None else _means(mesh.texcoords, number)
    small = Mesh(vertices, faces, texcoords, mesh.texture).without_slivers()
    _, once = np.unique(np.sort(small.faces, axis=1), axis=0, return_index=True)
    return Mesh(small.vertices, small.faces[np.sort(once)], small.texcoords, small.texture).without_strays()


def _patches(mesh: Mesh) -> NDArray[np.int64]:
    """Number of the connected part that each vertex belongs to; seams of the texture cut."""
    if mesh.texcoords is None:
        return np.zeros(len(mesh.vertices), dtype=np.int64)
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(mesh.vertices)
    starts, ends = mesh.faces.reshape(-1), np.roll(mesh.faces, -1, axis=1).reshape(-1)
    edges = coo_matrix((np.ones(starts.size), (starts, ends)), shape=(count, count))
    return np.asarray(connected_components(edges, directed=False)[1], dtype=np.int64)


def _means(values: NDArray[np.float64], groups: NDArray[np.int64]) -> NDArray[np.float64]:
    counts = np.bincount(groups)
    sums = np.stack([np.bincount(groups, values[:, i]) for i in range(values.shape[1])], axis=1)
    return sums / np.maximum(counts, 1)[:, None]
