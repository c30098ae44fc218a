"""What no camera saw of a body: the mirror image of what one saw, and what closes the hull of both."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.spatial import ConvexHull, QhullError, cKDTree
from torch import Tensor, nn

from vpd_lightning.dynamics.inertial.body_motion import matrices_of, vectors_of
from vpd_lightning.dynamics.inertial.first_motion import take
from vpd_lightning.dynamics.inertial.first_velocity import Surfels
from vpd_lightning.dynamics.inertial.rigid_motion import rotate
from vpd_lightning.dynamics.inertial.shading import MovingShading
from vpd_lightning.types import HiddenSide

_SEEN_WITHIN = 1.5
"""Spacings around a particle within which the surface is known, and nothing has to be guessed."""

_OUTSIDE_BY, _MOST_OUTSIDE = 1.5, 0.05
"""A guess may lie outside of this share of its body's tangent planes by more than this many spacings; else it would
stand out where a camera saw that nothing is."""

_BEFORE, _BESIDE = 0.5, 1.0
"""Nor may it lie farther than so many spacings before a seen particle and within so many beside its normal: a camera
looked into a dent there."""

_MOST_FILLING = 512
"""Particles that close the hull of one body."""


@dataclass(frozen=True)
class HiddenParticles:
    """Guessed particles at ``sum_k weights_k x_k + (1 - sum_k weights_k) c``, with seen particles x and the centre c.

    A mirror image has one weight of -1; what closes a hull lies between three particles or images of some.
    """

    index: Int64[Tensor, "batch hidden corner"]  # among the particles that may move
    weights: Float[Tensor, "batch hidden corner"]
    own: Int64[Tensor, "batch hidden"]  # the number of the body
    mask: Bool[Tensor, "batch hidden"]
    normals: Float[Tensor, "batch hidden 3"]  # as they are now
    features: Float[Tensor, "batch hidden feature"]  # at first
    first_shade: Float[Tensor, "batch hidden feature"]


@dataclass(frozen=True)
class _Guess:
    """Guessed particles of one body; see ``HiddenParticles``."""

    index: np.ndarray
    weights: np.ndarray
    normals: np.ndarray


class HiddenGuess(nn.Module):
    """Guesses the hidden side of bodies: features between their mean and what lies opposite, a learned share of each.

    The far side of a ball of one colour looks like the near one; of a die it does not, and the mean errs least.
    """

    def __init__(self, *, feature_dim: int):
        super().__init__()
        self.logit_of_opposite = nn.Parameter(torch.zeros(feature_dim))

    def forward(
        self,
        seen: Surfels,
        bodies: Float[Tensor, "batch body moving"],
        own: Int64[Tensor, "batch moving"],
        centers: Float[Tensor, "batch body 3"],
        free: Bool[Tensor, "batch moving"],
        shading: MovingShading,
    ) -> HiddenParticles:
        """Return what is guessed of each body; only particles that are ``free`` may have a mirror image."""
        hidden = _found(seen, bodies, centers, free)
        shares = bodies / bodies.sum(dim=-1, keepdim=True).clamp(min=1)
        mean = vectors_of(shares @ seen.features, hidden.own)
        corners = hidden.weights.abs() / hidden.weights.abs().sum(dim=-1, keepdim=True).clamp(min=1e-6)
        opposite = (corners[..., None] * _corners(seen.features, hidden.index)).sum(dim=2)
        features = mean + torch.sigmoid(self.logit_of_opposite) * (opposite - mean)
        return replace(hidden, features=features, first_shade=shading(features, hidden.normals))


def hidden_after(
    hidden: HiddenParticles,
    positions: Float[Tensor, "batch moving 3"],
    centers: Float[Tensor, "batch body 3"],
    rotations: Float[Tensor, "batch body 3 3"],
    shading: MovingShading,
    origin: Float[Tensor, "batch 1 3"],
) -> tuple[HiddenParticles, HiddenSide]:
    """Return the hidden side of bodies that were turned by ``rotations``; positions are relative to ``origin``."""
    hidden = replace(hidden, normals=rotate(matrices_of(rotations, hidden.own), hidden.normals))
    placed = (hidden.weights[..., None] * _corners(positions, hidden.index)).sum(dim=2)
    placed = placed + (1 - hidden.weights.sum(dim=-1, keepdim=True)) * vectors_of(centers, hidden.own)
    features = hidden.features + (shading(hidden.features, hidden.normals) - hidden.first_shade)
    return hidden, HiddenSide(placed + origin, features, hidden.normals, hidden.mask)


def _corners(values: Tensor, index: Tensor) -> Float[Tensor, "batch hidden corner channel"]:
    return take(values, index.flatten(1)).unflatten(1, index.shape[1:])


@torch.no_grad()
def _found(seen: Surfels, bodies: Tensor, centers: Tensor, free: Tensor) -> HiddenParticles:
    """Return what is guessed, yet without features; body by body, on the CPU."""
    found: list[list[tuple[int, _Guess]]] = []
    parts = [part.detach().cpu().double().numpy() for part in (seen.positions, seen.normals, centers)]
    members = (bodies > 0).cpu().numpy(), free.cpu().numpy()
    for positions, normals, middles, belongs, may_mirror in zip(*parts, *members, strict=True):
        found.append([])
        for number, of_body in enumerate(belongs):
            slots = np.flatnonzero(of_body)
            guess = _guessed(positions[slots], normals[slots], middles[number], may_mirror[slots])
            if guess is not None:
                found[-1].append((number, replace(guess, index=slots[guess.index])))
    count = max(1, *(sum(len(guess.index) for _, guess in member) for member in found))
    like, index = seen.positions, torch.zeros(len(found), count, 3, dtype=torch.int64)
    weights, normals_of = torch.zeros(len(found), count, 3), torch.zeros(len(found), count, 3)
    own, mask = torch.zeros(len(found), count, dtype=torch.int64), torch.zeros(len(found), count, dtype=torch.bool)
    for row, member in enumerate(found):
        start = 0
        for number, guess in member:
            some = slice(start, start := start + len(guess.index))
            index[row, some] = torch.from_numpy(guess.index)
            weights[row, some] = torch.from_numpy(guess.weights).to(weights)
            normals_of[row, some] = torch.from_numpy(guess.normals).to(weights)
            own[row, some], mask[row, some] = number, True
    index, own, mask = (part.to(like.device) for part in (index, own, mask))
    none = like.new_zeros(len(found), count, 0)
    return HiddenParticles(index, weights.to(like), own, mask, normals_of.to(like), none, none)


def _guessed(positions: np.ndarray, normals: np.ndarray, center: np.ndarray, may_mirror: np.ndarray) -> _Guess | None:
    """Return what is guessed of one body from its particles (axes ``particle 3``)."""
    if len(positions) < 5:
        return None
    tree = cKDTree(positions)
    spacing = float(np.median(tree.query(positions, k=5)[0][:, -1]))
    known = (normals**2).sum(axis=-1) > 0.5
    if spacing == 0 or not known.any():
        return None

    def has_room(places: np.ndarray) -> np.ndarray:
        # Products of matrices in place of a difference for every pair: places are near the centre, in double precision.
        seen, out, around = positions[known] - center, normals[known], places - center
        before = around @ out.T - (seen * out).sum(axis=-1)
        beside = (around**2).sum(axis=-1)[:, None] - 2 * around @ seen.T + (seen**2).sum(axis=-1) - before**2
        outside = (before > _OUTSIDE_BY * spacing).mean(axis=-1) > _MOST_OUTSIDE
        return ~(outside | ((before > _BEFORE * spacing) & (beside < (_BESIDE * spacing) ** 2)).any(axis=-1))

    images = 2 * center - positions
    opposite = np.flatnonzero(may_mirror & known & (tree.query(images)[0] > _SEEN_WITHIN * spacing))
    opposite = opposite[has_room(images[opposite])]
    mirrored = _Guess(
        index=np.repeat(opposite[:, None], 3, axis=1),
        weights=np.tile([-1.0, 0.0, 0.0], (len(opposite), 1)),
        normals=-normals[opposite],
    )
    filling = _filling(np.concatenate([positions, images[opposite]]), spacing)
    if filling is None:
        return mirrored if len(opposite) else None
    corners, shares, outward = filling
    is_image = corners >= len(positions)
    index = np.where(is_image, np.r_[np.arange(len(positions)), opposite][corners], corners)
    weights = np.where(is_image, -shares, shares)
    places = (weights[..., None] * positions[index]).sum(axis=1) + (1 - weights.sum(axis=1))[:, None] * center
    kept = has_room(places)
    return _Guess(
        np.concatenate([mirrored.index, index[kept]]),
        np.concatenate([mirrored.weights, weights[kept]]),
        np.concatenate([mirrored.normals, outward[kept]]),
    )


def _filling(points: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return places on the convex hull of points, a spacing apart, that are far from all of them; None without any.

    As the three points that span each, their shares in it (which sum to one), and the outward normal.
    """
    try:
        hull = ConvexHull(points)
    except QhullError:  # too few, or in a plane
        return None
    a, b, c = points[hull.simplices].swapaxes(0, 1)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2
    counts = np.ceil(areas / spacing**2).astype(int)
    facet = np.repeat(np.arange(len(counts)), counts)
    ordinal = np.arange(len(facet)) - np.repeat(np.cumsum(counts) - counts, counts)
    # Evenly spread over a triangle (Roberts' sequence), for any number of them.
    u, v = (ordinal + 0.5) * 0.7548776662466927 % 1, (ordinal + 0.5) * 0.5698402909980532 % 1
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    shares = np.stack([1 - u - v, u, v], axis=-1)
    corners = hull.simplices[facet]
    places = (shares[..., None] * points[corners]).sum(axis=1)
    far = np.flatnonzero(cKDTree(points).query(places)[0] > _SEEN_WITHIN * spacing)
    far = far[np.linspace(0, len(far) - 1, min(len(far), _MOST_FILLING)).astype(int)] if len(far) else far
    if len(far) == 0:
        return None
    return corners[far], shares[far], hull.equations[facet[far], :3]
