"""Where moving particles are in relation to what stands still, and keeping them out of it."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.dynamics.rigid_motion import Twists, cross, rotate, rotation_from_spin


@dataclass(frozen=True)
class Contacts:
    """For each probe: signed distance (metres, positive outside), surface normal, and lateral offset (metres)."""

    distances: Float[Tensor, "batch probe"]
    normals: Float[Tensor, "batch probe 3"]
    lateral: Float[Tensor, "batch probe"]


def nearest_static_contacts(
    probes: Float[Tensor, "batch probe 3"],
    static_positions: Float[Tensor, "batch particle 3"],
    static_normals: Float[Tensor, "batch particle 3"],
    static_mask: Bool[Tensor, "batch particle"],
    far: float,
) -> Contacts:
    """Measure each probe against the tangent plane of its nearest static particle whose normal is known.

    The point-to-plane distance is exact on flat surfaces however sparse the particles are. Without any static
    particle, or beyond ``far`` metres, the distance is ``far`` and the normal zero: no contact.
    """
    with torch.no_grad():
        oriented = static_mask & (static_normals.square().sum(dim=-1) > 0.5)
        square = (probes[:, :, None] - static_positions[:, None]).square().sum(dim=-1)
        nearest_square, index = square.masked_fill(~oriented[:, None], float("inf")).min(dim=-1)
    batch = torch.arange(len(probes), device=probes.device)[:, None]
    normals = static_normals[batch, index]
    offsets = probes - static_positions[batch, index]
    distances = (offsets * normals).sum(dim=-1)
    lateral = (offsets - distances[..., None] * normals).square().sum(dim=-1).clamp(min=1e-12).sqrt()
    known = torch.isfinite(nearest_square) & (nearest_square < far**2)
    return Contacts(
        distances=torch.where(known, distances, torch.full_like(distances, far)),
        normals=normals * known[..., None],
        lateral=torch.where(known, lateral, torch.full_like(lateral, far)),
    )


def resolve_contacts(
    twists: Twists,
    positions: Float[Tensor, "batch probe 3"],
    contacts: Contacts,
    belongs: Bool[Tensor, "batch anchor probe"],
    inverse_inertia: Float[Tensor, "batch anchor 3 3"],
    friction: Float[Tensor, ""],
    *,
    num_iterations: int,
    max_depth: float,
) -> Twists:
    """Correct the twists of one step so that no probe ends up inside what stands still.

    Position-based dynamics (Mueller et al. 2007, 2020): each round takes the deepest probe of each anchor and applies
    the smallest impulse at that point that lifts it out, to displacement and spin alike, and an impulse against its
    sliding of at most ``friction`` times that (Coulomb). What is carried on to the next step has lost the motion into
    the surface: an inelastic impact; a body that tips over an edge gets its torque. Bounce is left to what is learned.
    Probes that were deeper than ``max_depth`` (metres) before the step are left alone: their surface is not to be
    trusted.
    """
    offsets = positions[:, None] - twists.centers[:, :, None]
    normals = contacts.normals[:, None].expand_as(offsets)
    known = (contacts.normals.square().sum(dim=-1) > 0.5) & (contacts.distances > -max_depth)
    touchable = belongs & known[:, None]
    displacements, spins = twists.displacements, twists.spins
    for _ in range(num_iterations):
        turned = rotate(rotation_from_spin(spins)[:, :, None], offsets)
        moves = displacements[:, :, None] + turned - offsets
        ahead = contacts.distances[:, None] + (moves * normals).sum(dim=-1)
        deepest, probe = ahead.masked_fill(~touchable, torch.inf).min(dim=-1, keepdim=True)
        at = probe[..., None].expand(-1, -1, -1, 3)
        normal = torch.gather(normals, 2, at).squeeze(2)
        arm = torch.gather(turned, 2, at).squeeze(2)
        lift = torch.relu(-deepest) * _response(arm, normal, inverse_inertia)
        push = lift * normal
        displacements, spins = displacements + push, spins + rotate(inverse_inertia, cross(arm, push))

        move = torch.gather(moves, 2, at).squeeze(2) + push + cross(rotate(inverse_inertia, cross(arm, push)), arm)
        sliding = move - (move * normal).sum(dim=-1, keepdim=True) * normal
        speed = sliding.square().sum(dim=-1, keepdim=True).clamp(min=1e-12).sqrt()
        direction = sliding / speed
        stop = speed * _response(arm, direction, inverse_inertia)
        push = -torch.minimum(stop, friction * lift) * direction
        displacements, spins = displacements + push, spins + rotate(inverse_inertia, cross(arm, push))
    return Twists(twists.centers, displacements, spins)


def _response(arm: Tensor, direction: Tensor, inverse_inertia: Tensor) -> Tensor:
    """Return the impulse along ``direction`` that moves the point at ``arm`` by one unit along it, for unit mass."""
    lever = cross(arm, direction)
    return 1 / (1 + (lever * rotate(inverse_inertia, lever)).sum(dim=-1, keepdim=True))
