"""Rigid motions of weighted point sets: closed-form fits, applied and estimated without correspondences."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn


@dataclass(frozen=True)
class Twists:
    """Motion of each anchor over one step: its centre, displacement (metres) and ``spin`` = 2 tan(angle / 2) * axis."""

    centers: Float[Tensor, "*batch anchor 3"]
    displacements: Float[Tensor, "*batch anchor 3"]
    spins: Float[Tensor, "*batch anchor 3"]


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Return the vector product over the last axis, with broadcasting."""
    a, b = torch.broadcast_tensors(a, b)
    return torch.linalg.cross(a, b)


def weighted_sum(weights: Float[Tensor, "*batch anchor particle"], values: Tensor) -> Tensor:
    """Sum values (``... particle c``) over particles with the weights of each anchor, in full precision."""
    return (weights[..., None] * values[..., None, :, :]).sum(dim=-2)


def fit_twists(
    positions: Float[Tensor, "batch particle 3"],
    displacements: Float[Tensor, "batch particle 3"],
    weights: Float[Tensor, "batch anchor particle"],
) -> Twists:
    """Fit a rigid motion to the last displacement of each anchor's particles by weighted least squares.

    Offsets are taken at the midpoints of the motion, where the Cayley form is exact for rigid motion: no SVD, smooth
    gradients. ``weights`` sum to one over particles. ``positions`` are those after the displacement.
    """
    center = weighted_sum(weights, positions)
    mean = weighted_sum(weights, displacements)
    middle = (positions - displacements / 2)[:, None] - (center - mean / 2)[:, :, None]
    momentum = (weights[..., None] * cross(middle, displacements[:, None] - mean[:, :, None])).sum(dim=2)
    spins = torch.linalg.solve(_inertia(middle, weights), momentum)
    return Twists(center, mean, spins)


def equidistant_centers(
    positions: Float[Tensor, "batch particle 3"],
    normals: Float[Tensor, "batch particle 3"],
    weights: Float[Tensor, "batch anchor particle"],
    extent_weight: float = 0.0,
) -> Float[Tensor, "batch anchor 3"]:
    """Find the point at equal distance from all tangent planes: the centre of a ball or cube of which a part is seen.

    Least squares of n . (x - c) = h over (c, h). Three faces of a cube leave the distance h open. So each particle also
    asks with ``extent_weight`` that the centre lie midway between the first and the last of its anchor's particles
    along its normal: of a cube, the other faces show how deep it is. Where even that leaves a direction open (one
    face), a weak pull towards the particles' mean decides. The mean itself would be off by what is hidden, and a
    spinning body would be carried around the wrong point.
    """
    known = weights * (normals.square().sum(dim=-1) > 0.5)[:, None]
    known = known / known.sum(dim=-1, keepdim=True).clamp(min=1e-12)
    mean = weighted_sum(weights, positions)
    rows = torch.cat([normals, torch.ones_like(normals[..., :1])], dim=-1)
    heights = (normals[:, None] * (positions[:, None] - mean[:, :, None])).sum(dim=-1)
    matrix = torch.einsum("bap,bpi,bpj->baij", known, rows, rows)
    right = torch.einsum("bap,bpi,bap->bai", known, rows, heights)
    pull = torch.diag(positions.new_tensor([0.01, 0.01, 0.01, 1e-4]))
    if extent_weight > 0:
        pull = pull / 10  # what is left open is little
        level = nn.functional.pad(normals, (0, 1))
        middles = _middles(positions, normals, weights)[:, None] - (normals[:, None] * mean[:, :, None]).sum(dim=-1)
        matrix = matrix + extent_weight * torch.einsum("bap,bpi,bpj->baij", known, level, level)
        right = right + extent_weight * torch.einsum("bap,bpi,bap->bai", known, level, middles)
    offset = torch.linalg.solve(matrix + pull, right)[..., :3]
    reach = weighted_sum(weights, positions.square()).sum(-1) - mean.square().sum(-1)
    limit = reach.clamp(min=1e-12).sqrt()[..., None]  # never farther than the particles themselves reach
    length = offset.square().sum(dim=-1, keepdim=True).clamp(min=1e-12).sqrt()
    return mean + offset * (limit / length).clamp(max=1)


_STRAYS = 0.01
"""Share of the particles at either end that do not count for a body's extent."""


def _middles(positions: Tensor, normals: Tensor, weights: Tensor) -> Float[Tensor, "batch particle"]:
    """Return where along its normal each particle's anchor has its middle (n . x, metres)."""
    belongs = (weights > 0).to(positions.dtype)
    others = belongs.mT @ belongs == 0
    heights = normals @ positions.mT
    rank = max(1, round(_STRAYS * positions.shape[1]))
    highest = heights.masked_fill(others, -torch.inf).topk(rank, dim=-1).values
    lowest = heights.masked_fill(others, torch.inf).topk(rank, dim=-1, largest=False).values
    # An anchor of fewer particles than that has all of them among these.
    high = torch.where(highest.isfinite(), highest, torch.inf).amin(dim=-1)
    low = torch.where(lowest.isfinite(), lowest, -torch.inf).amax(dim=-1)
    return torch.where(high.isfinite() & low.isfinite(), (high + low) / 2, 0.0)


def _inertia(offsets: Tensor, weights: Tensor) -> Tensor:
    square = (weights * offsets.square().sum(dim=-1)).sum(dim=-1)
    outer = (weights[..., None, None] * offsets[..., :, None] * offsets[..., None, :]).sum(dim=-3)
    eye = torch.eye(3, dtype=offsets.dtype, device=offsets.device)
    # The ridge keeps a flat or single-point anchor solvable; it is small against any body of more than a centimetre.
    return square[..., None, None] * eye - outer + 1e-6 * eye


def rotation_from_spin(spins: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation of a spin vector 2 tan(angle / 2) * axis (Cayley transform): orthonormal for any input."""
    half = spins / 2
    x, y, z = half.unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    eye = torch.eye(3, dtype=spins.dtype, device=spins.device)
    square = half.square().sum(dim=-1)[..., None, None]
    outer = half[..., :, None] * half[..., None, :]
    return ((1 - square) * eye + 2 * outer + 2 * skew) / (1 + square)


def rotate(rotation: Float[Tensor, "*#batch 3 3"], vectors: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "... 3"]:
    """Rotate vectors by explicit sums, so that autocast cannot lower their precision."""
    return (rotation * vectors[..., None, :]).sum(dim=-1)


def rigid_fit(
    source: Float[Tensor, "batch particle 3"],
    goal: Float[Tensor, "batch particle 3"],
    weights: Float[Tensor, "batch anchor particle"],
) -> tuple[Float[Tensor, "batch anchor 3 3"], Float[Tensor, "batch anchor 3"], Float[Tensor, "batch anchor 3"]]:
    """Fit rotation and centres of source -> goal for each anchor (Kabsch 1976), in float64 for the SVD.

    Returns (rotation, source centre, goal centre): a point x goes to rotation (x - source centre) + goal centre.
    """
    weights = weights / weights.sum(dim=-1, keepdim=True).clamp(min=1e-12)
    source_center, goal_center = weighted_sum(weights, source), weighted_sum(weights, goal)
    a = source[:, None] - source_center[:, :, None]
    b = goal[:, None] - goal_center[:, :, None]
    covariance = torch.einsum("kap,kapi,kapj->kaij", weights, b, a).double()
    eye = torch.eye(3, dtype=covariance.dtype, device=covariance.device)
    u, _, vt = torch.linalg.svd(covariance + 1e-7 * eye)
    flip = torch.ones_like(u[..., 0])
    flip[..., 2] = torch.sign(torch.linalg.det(u @ vt))
    rotation = (u * flip[..., None, :]) @ vt
    return rotation.to(source.dtype), source_center, goal_center
