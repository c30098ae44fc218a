"""Object-like clusters: which particles hang together, and apart from wide flat scenery."""

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.spatial import cKDTree
from torch import Tensor

from vpd_lightning.graph.bodies import label_bodies
from vpd_lightning.types import Particles

_RANK = 4
"""The distance to this many-th nearest particle is what is called spacing."""

_LINK = 2.5
"""Two particles hang together within this many spacings."""

_BODY_LINK, _MAX_CONCAVITY, _MAX_CONCAVE_SHARE, _MAX_BODIES = 1.7, 0.15, 0.35, 64
"""Bodies as ``conf/dynamics/inertial.yaml`` finds them, only more of them."""

_MIN_PARTICLES = 8
"""Fewer particles are no cluster."""

_MIN_PLANE_SHARE = 0.2
"""A plane through at least this share of all particles is scenery (where no mask of scenery is given)."""

_MAX_PLANES = 3

_MIN_PLANE_WIDTH = 0.25
"""The narrower side of such a plane is at least this share of the scene's diagonal: bodies in a row are no floor."""


def object_clusters(particles: Particles) -> Int64[Tensor, " particle"]:
    """Return the cluster of each particle of one frame (batch axis of 1), from 0 (most particles) on; -1 elsewhere.

    Scenery and what hangs together with fewer than eight particles is -1. Where an encoder marked what may move, all
    else is scenery; where none did, the widest planes are. The others are divided into what convexly hangs together
    where normals and colours were observed (``graph.bodies``), so that bodies which touch stay two; and else by
    DBSCAN (scikit-learn) over places, to which bodies that touch are one.
    """
    labels = torch.full((particles.num_particles,), -1, dtype=torch.int64)
    there = particles.mask[0].cpu()
    where = there.nonzero().flatten().numpy()
    if len(where) < _MIN_PARTICLES:
        return labels.to(particles.positions.device)
    points = particles.positions[0].detach().cpu().double().numpy()[where]
    known = particles.moving
    dynamic_mask = ~_on_wide_planes(points) if known is None else known[0].cpu().numpy()[where]
    found = np.full(len(where), -1)
    if dynamic_mask.sum() >= _MIN_PARTICLES:
        found[dynamic_mask] = (
            _divided(points[dynamic_mask])
            if particles.normals is None or particles.colors is None
            else _bodies(particles, where[dynamic_mask])
        )
    labels[torch.from_numpy(where)] = torch.from_numpy(_by_size(found))
    return labels.to(particles.positions.device)


def usual_spacing(points: Float[np.ndarray, "particle 3"]) -> float:
    """Return the median distance (metres) to the fourth nearest other particle; 1 where there is only one."""
    rank = min(_RANK, len(points) - 1)
    if rank < 1:
        return 1.0
    return max(float(np.median(cKDTree(points).query(points, k=[rank + 1])[0])), 1e-9)


def _bodies(particles: Particles, chosen: np.ndarray) -> np.ndarray:
    assert particles.normals is not None and particles.colors is not None
    index = torch.from_numpy(chosen).to(particles.positions.device)
    positions, normals, colors = (
        values[:, index] for values in (particles.positions, particles.normals, particles.colors)
    )
    mask = torch.ones_like(positions[..., 0], dtype=torch.bool)
    found = label_bodies(
        positions - positions[:, :1],
        normals,
        colors,
        mask,
        num_bodies=_MAX_BODIES,
        link=_BODY_LINK,
        max_concavity=_MAX_CONCAVITY,
        max_concave_share=_MAX_CONCAVE_SHARE,
    )
    return found[0].cpu().numpy()


def _divided(points: np.ndarray) -> np.ndarray:
    from sklearn.cluster import DBSCAN

    reach = _LINK * usual_spacing(points)
    labels = DBSCAN(eps=reach, min_samples=_RANK).fit_predict(points)
    sizes = np.bincount(labels[labels >= 0], minlength=1)
    large = np.flatnonzero(sizes >= _MIN_PARTICLES)
    known = np.isin(labels, large)
    if not known.any():
        return np.full(len(points), -1)
    # Strays between clusters belong to the nearest one: an edge seen from the side has few particles.
    distance, nearest = cKDTree(points[known]).query(points[~known])
    labels[~known] = np.where(distance <= reach, labels[known][nearest], -1)
    return labels


def _on_wide_planes(points: np.ndarray) -> np.ndarray:
    """Return which points lie on a plane that holds a fifth of all, plane after plane (RANSAC)."""
    tolerance = 0.5 * usual_spacing(points)
    narrowest = _MIN_PLANE_WIDTH * float(np.linalg.norm(np.ptp(points, axis=0)))
    scenery = np.zeros(len(points), dtype=bool)
    for _ in range(_MAX_PLANES):
        rest = np.flatnonzero(~scenery)
        if len(rest) < max(_MIN_PARTICLES, _MIN_PLANE_SHARE * len(points)):
            break
        inside = _best_plane(points[rest], tolerance)
        if inside.sum() < _MIN_PLANE_SHARE * len(points) or _narrow_side(points[rest[inside]]) < narrowest:
            break
        scenery[rest[inside]] = True
    return scenery


def _narrow_side(points: np.ndarray) -> float:
    """Return the extent (metres) of nearly flat points along the second of their principal axes."""
    offsets = points - points.mean(axis=0)
    axes = np.linalg.eigh(offsets.T @ offsets)[1]
    return float(np.ptp(offsets @ axes[:, 1]))


def _best_plane(points: np.ndarray, tolerance: float, num_trials: int = 200) -> np.ndarray:
    """Return which points lie within ``tolerance`` of the plane through three of them that most others are near."""
    generator = np.random.default_rng(0)
    triples = points[generator.integers(len(points), size=(num_trials, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    proper = lengths > 1e-12
    if not proper.any():
        return np.zeros(len(points), dtype=bool)
    normals = normals[proper] / lengths[proper, None]
    heights = np.einsum("pi,ti->tp", points, normals) - np.einsum("ti,ti->t", triples[proper, 0], normals)[:, None]
    inside = np.abs(heights) < tolerance
    return inside[inside.sum(axis=1).argmax()]


def _by_size(labels: np.ndarray) -> np.ndarray:
    """Number clusters anew: the one of most particles is 0, equal ones in the order of their first particle."""
    known = labels >= 0
    if not known.any():
        return labels
    names, first, counts = np.unique(labels[known], return_index=True, return_counts=True)
    order = np.lexsort([first, -counts])
    rank = np.empty(len(names), dtype=np.int64)
    rank[order] = np.arange(len(names))
    numbered = np.full(len(labels), -1, dtype=np.int64)
    numbered[known] = rank[np.searchsorted(names, labels[known])]
    return numbered
