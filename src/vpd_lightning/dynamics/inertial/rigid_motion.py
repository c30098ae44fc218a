"""Rigid motions of weighted point sets: closed-form fits, applied and estimated without correspondences."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


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
) -> Float[Tensor, "batch anchor 3"]:
    """Find the point at equal distance from all tangent planes: the centre of a ball or cube of which a part is seen.

    Least squares of n . (x - c) = h over (c, h). Where the seen surface leaves a direction open (one face), a weak
    pull towards the particles' mean decides. The mean itself would be off by what is hidden, and a spinning body
    would be carried around the wrong point.
    """
    known = weights * (normals.square().sum(dim=-1) > 0.5)[:, None]
    known = known / known.sum(dim=-1, keepdim=True).clamp(min=1e-12)
    mean = weighted_sum(weights, positions)
    rows = torch.cat([normals, torch.ones_like(normals[..., :1])], dim=-1)
    heights = (normals[:, None] * (positions[:, None] - mean[:, :, None])).sum(dim=-1)
    matrix = torch.einsum("bap,bpi,bpj->baij", known, rows, rows)
    right = torch.einsum("bap,bpi,bap->bai", known, rows, heights)
    pull = torch.diag(positions.new_tensor([0.01, 0.01, 0.01, 1e-4]))
    offset = torch.linalg.solve(matrix + pull, right)[..., :3]
    reach = weighted_sum(weights, positions.square()).sum(-1) - mean.square().sum(-1)
    limit = reach.clamp(min=1e-12).sqrt()[..., None]  # never farther than the particles themselves reach
    length = offset.square().sum(dim=-1, keepdim=True).clamp(min=1e-12).sqrt()
    return mean + offset * (limit / length).clamp(max=1)


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
