"""Particles made of coloured points that no encoder saw."""

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from vpd_lightning.errors import EditError
from vpd_lightning.types import Particles

_NUM_NEIGHBORS = 12


def particles_of_points(
    positions: Float[Tensor, "point 3"],
    colors: Float[Tensor, "point 3"],
    like: Particles,
    like_colors: Float[Tensor, "particle 3"],
) -> Particles:
    """Return particles at ``positions`` with the features of the particles of ``like`` (batch of 1) nearest in colour.

    Where ``like`` has normals, these come from the planes of near points, pointing away from the points' centre; where
    it marks what may move, the points may.

    Raises:
        EditError: there is no particle to take features from.
    """
    there = like.mask[0]
    if not bool(there.any()):
        raise EditError("The scene has no particles, so nothing tells what features points should have.")
    known = like_colors[there].detach().cpu().double().numpy()
    nearest = cKDTree(known).query(colors.detach().cpu().double().numpy())[1]
    index = torch.from_numpy(nearest).to(there.device)
    places = positions.to(like.positions)[None]
    return Particles(
        positions=places,
        features=like.features[:, there][:, index],
        colors=None if like.colors is None else colors.to(like.positions)[None],
        moving=None if like.moving is None else torch.ones_like(places[..., 0], dtype=torch.bool),
        normals=None if like.normals is None else _outward_normals(positions).to(like.positions)[None],
    )


def _outward_normals(positions: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
    points = positions.detach().cpu().double().numpy()
    count = min(_NUM_NEIGHBORS, len(points))
    if count < 3:
        return torch.zeros(len(points), 3)
    near = points[cKDTree(points).query(points, k=count)[1]]
    offsets = near - near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("pki,pkj->pij", offsets, offsets))[1][:, :, 0]
    outward = np.sign(np.einsum("pi,pi->p", normals, points - points.mean(axis=0)))
    return torch.from_numpy(normals * np.where(outward == 0, 1.0, outward)[:, None])
