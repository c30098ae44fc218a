"""What stands still, as contact sees it: also under bodies, and no farther than its edges."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, vectors_of
from vpd_lightning.dynamics.inertial.contact import ContactPoints, Contacts, nearest_static_contacts
from vpd_lightning.dynamics.inertial.nearest import nearest_usable
from vpd_lightning.geometry.spacing import point_spacing

_MOST_CLEARANCE = 0.75
"""Of a body's size: what seems to end farther above its surface, or below it, does not rest on that one."""


@dataclass(frozen=True)
class StaticSurface:
    """Points of what stands still that no camera saw, and how far a seen one reaches; lengths in metres.

    ``positions`` are the footprints of bodies: what lies under them on the surface below. ``reach`` is how far beside a
    point its surface goes on (infinite: it has no edge). ``clearances`` are how far above their surface (below it,
    where negative) the points of resting bodies seem to end.
    """

    positions: Float[Tensor, "batch footprint 3"]
    normals: Float[Tensor, "batch footprint 3"]
    mask: Bool[Tensor, "batch footprint"]
    reach: Float[Tensor, " batch"]
    clearances: Float[Tensor, "batch body"]


@torch.no_grad()
def static_surface(
    statics: tuple[Tensor, Tensor, Tensor],
    above: Float[Tensor, "batch point 3"],
    is_above: Bool[Tensor, "batch point"],
    edge_reach: float | None,
    clearances: Float[Tensor, "batch body"],
) -> StaticSurface:
    """Return what contact needs beside the static particles (positions, normals, mask).

    ``above`` are points of what hides the surface below it: bodies, and what is driven. Each is projected on the
    tangent plane of the static particle nearest to it. ``edge_reach`` is in spacings of the static particles; null: a
    surface goes on without end, and there are no footprints.
    """
    positions, normals, mask = statics
    if edge_reach is None:
        nothing = above[:, :0], above[:, :0], is_above[:, :0]
        return StaticSurface(*nothing, torch.full_like(above[:, 0, 0], torch.inf), clearances)
    oriented = mask & (normals.square().sum(dim=-1) > 0.5)
    index, exists = nearest_usable(above, positions, oriented)
    facing = vectors_of(normals, index)
    heights = ((above - vectors_of(positions, index)) * facing).sum(dim=-1, keepdim=True)
    known = exists & is_above
    return StaticSurface(
        positions=torch.where(known[..., None], above - heights * facing, 0.0),
        normals=torch.where(known[..., None], facing, 0.0),
        mask=known,
        reach=edge_reach * point_spacing(positions, mask),
        clearances=clearances,
    )


def static_contacts(
    surface: StaticSurface,
    points: ContactPoints,
    statics: tuple[Tensor, Tensor, Tensor],
    far: float,
) -> Contacts:
    """Measure contact points against the static particles and footprints; resting bodies from where they rest."""
    parts = zip(statics, (surface.positions, surface.normals, surface.mask), strict=True)
    joined = [torch.cat(part, dim=1) for part in parts] if surface.mask.shape[1] else list(statics)
    found = nearest_static_contacts(points.positions, joined[0], joined[1], joined[2], far)
    is_on = found.lateral < surface.reach[:, None]
    lowered = found.distances - torch.gather(surface.clearances, 1, points.bodies)
    # Without a surface near, the distance is the farthest there is.
    known = found.normals.square().sum(dim=-1) > 0.5
    return Contacts(
        distances=torch.where(known & is_on, lowered, torch.full_like(found.distances, far)),
        normals=found.normals * is_on[..., None],
        lateral=torch.where(is_on, found.lateral, torch.full_like(found.lateral, far)),
    )


@torch.no_grad()
def resting_clearances(
    points: ContactPoints,
    statics: tuple[Tensor, Tensor, Tensor],
    motion: BodyMotion,
    sizes: Float[Tensor, "batch body"],
    max_speed: float,
    far: float,
) -> tuple[Float[Tensor, "batch body"], Bool[Tensor, "batch body"]]:
    """Return how far above its surface each body's lowest point seems to be, and which bodies rest or slide on one.

    Cameras do not see the seam between a body and what it stands on, a body is a sample of points, and its hidden side
    is a guess. One that does not approach its surface (slower than ``max_speed``, metres per step, along the normal)
    and is near is supported: there it ends. Zero for all others.
    """
    found = nearest_static_contacts(points.positions, *statics, far)
    belongs = (points.members > 0) & (found.normals.square().sum(dim=-1) > 0.5)[:, None]
    gaps, lowest = found.distances[:, None].masked_fill(~belongs, torch.inf).min(dim=-1)
    normals = vectors_of(found.normals, lowest)
    approach = (motion.displacements * normals).sum(dim=-1).abs()
    is_supported = (approach < max_speed) & (gaps.abs() < _MOST_CLEARANCE * sizes)
    return torch.where(is_supported, gaps, 0.0), is_supported
