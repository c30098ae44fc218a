"""How a body turns, how fast it moves, what energy it has, and when it strikes something. Metres, seconds, degrees."""

import torch
from jaxtyping import Float
from torch import Tensor

GRAVITY = 9.81
"""Metres per square second along -z. MOVi is made with 10, which shifts energies by 0.2 J/kg per metre of height."""


def best_rotation(
    start: Float[Tensor, "particle 3"], moved: Float[Tensor, "step particle 3"]
) -> Float[Tensor, "step 3 3"]:
    """Rotation that carries ``start`` to each step best, each about its centroid (Kabsch 1976)."""
    covariance = torch.einsum("spi,pj->sij", moved - moved.mean(1, keepdim=True), start - start.mean(0))
    u, _, vh = torch.linalg.svd(covariance)
    sign = torch.ones_like(u[..., 0, :])
    sign[..., -1] = torch.det(u @ vh).sign()
    return (u * sign.unsqueeze(-2)) @ vh


def orientation_error(
    pred: Float[Tensor, "step particle 3"], true: Float[Tensor, "step particle 3"], start: Float[Tensor, "particle 3"]
) -> Float[Tensor, " step"]:
    """Angle in degrees between the rotations since ``start`` of the particles and of their true positions."""
    relative = best_rotation(start, pred).mT @ best_rotation(start, true)
    skew = torch.stack([relative[:, i, j] - relative[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], -1).norm(dim=-1)
    trace = relative.diagonal(dim1=-2, dim2=-1).sum(-1)
    # The arc tangent keeps its digits at small angles, where the arc cosine of the trace loses half of them.
    return torch.rad2deg(torch.atan2(skew, trace - 1))


def centroid_velocity(positions: Float[Tensor, "time particle 3"], frame_time: float) -> Float[Tensor, "step 3"]:
    """Velocity of the centroid in metres per second over each step."""
    return positions.mean(1).diff(dim=0) / frame_time


def specific_energy(positions: Float[Tensor, "time particle 3"], frame_time: float) -> Float[Tensor, " step"]:
    """Kinetic and potential energy of the centroid in joules per kilogram, in the middle of each step."""
    centroid = positions.mean(1)
    kinetic = centroid_velocity(positions, frame_time).square().sum(-1) / 2
    return kinetic + GRAVITY * (centroid[1:, 2] + centroid[:-1, 2]) / 2


def first_contact(vertical_velocity: Float[Tensor, "*body step"], min_speed: float) -> Float[Tensor, "*body"]:
    """The step (from 0) at which a body that fell faster than ``min_speed`` (m/s) has lost half of its greatest speed.

    Infinite where that never happens. NaN counts as no contact.
    """
    known = vertical_velocity.nan_to_num(nan=torch.inf, posinf=torch.inf, neginf=torch.inf)
    fastest = known.cummin(-1).values[..., :-1]
    strikes = (fastest < -min_speed) & (vertical_velocity[..., 1:] >= fastest / 2)
    steps = torch.arange(1, vertical_velocity.shape[-1], dtype=torch.float64).expand(strikes.shape)
    never = torch.full((*strikes.shape[:-1], 1), torch.inf, dtype=torch.float64)
    return torch.cat([torch.where(strikes, steps, torch.inf), never], dim=-1).amin(-1)
