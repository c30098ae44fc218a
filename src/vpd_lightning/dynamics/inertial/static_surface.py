"""What stands still, as contact sees it: also under bodies, and no farther than its edges."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, vectors_of
from vpd_lightning.dynamics.inertial.contact_search import ContactPoints, Contacts, nearest_static_contacts
from vpd_lightning.dynamics.inertial.round_bodies import on_feet
from vpd_lightning.dynamics.inertial.surface_edges import SurfaceEdges, surface_edges
from vpd_lightning.geometry.spacing import point_spacing
from vpd_lightning.graph.neighbors import knn

_BEHIND = 0.005
"""Metres by which a seen point may be behind a tangent plane that it is above: noise of the plane."""

_AT_WALL = 2.0
"""Of its reach: how near to the side of the workspace a surface is cut by it, and goes on unseen."""

_NUM_NEIGHBOURS, _AGREEMENT = 8, 0.9
"""A normal is trusted that half of so many nearest particles share, to this cosine."""

_MOST_CLEARANCE, _MOST_SUNK = 0.75, 0.45
"""Of a body's size: what seems to end farther above its surface does not rest on it; farther below it, its guessed
hidden side is wrong (that of two bodies taken for one), and with it they would sink through."""


@dataclass(frozen=True)
class StaticSurface:
    """Points of what stands still that no camera saw, and how far a seen one reaches; lengths in metres.

    ``positions`` are the footprints of bodies: what lies under them on the surface below. ``edges`` is how far beside a
    point, of the static particles and then of the footprints, its surface goes on; None: without end. ``clearances``
    are how far above their surface (below it, where negative) the points of resting bodies seem to end.
    """

    positions: Float[Tensor, "batch footprint 3"]
    normals: Float[Tensor, "batch footprint 3"]
    mask: Bool[Tensor, "batch footprint"]
    edges: SurfaceEdges | None
    clearances: Float[Tensor, "batch body"]

    def joined(self, statics: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return static particles (positions, normals, mask) and behind them the footprints."""
        if self.mask.shape[1] == 0:
            return statics
        positions, normals, mask = statics
        return (
            torch.cat([positions, self.positions], dim=1),
            torch.cat([normals, self.normals], dim=1),
            torch.cat([mask, self.mask], dim=1),
        )


@torch.no_grad()
def trusted_normals(
    positions: Float[Tensor, "batch point 3"],
    normals: Float[Tensor, "batch point 3"],
    mask: Bool[Tensor, "batch point"],
) -> Float[Tensor, "batch point 3"]:
    """Return the normals, zero where less than half of the nearest particles share them.

    At an edge a normal is that of neither side, and its tangent plane cuts into what stands on the surface beside it.
    In noisy depth a stray particle of the floor is a wall, and without an edge one that goes on for metres.
    """
    oriented = mask & (normals.square().sum(dim=-1) > 0.5)
    trusted = torch.zeros_like(mask)
    for row, usable in enumerate(oriented):
        own = usable.nonzero()[:, 0]
        near = knn(positions[row, own], positions[row, own], _NUM_NEIGHBOURS + 1)
        others = near.mask & (near.index != torch.arange(len(own), device=own.device)[:, None])
        facing = normals[row, own]
        cosines = (facing[near.index] * facing[:, None]).sum(dim=-1)
        agreeing = (others & (cosines > _AGREEMENT)).sum(dim=-1)
        trusted[row, own] = 2 * agreeing >= others.sum(dim=-1)
    return normals * trusted[..., None]


@torch.no_grad()
def static_surface(
    statics: tuple[Tensor, Tensor, Tensor],
    above: Float[Tensor, "batch point 3"],
    is_above: Bool[Tensor, "batch point"],
    edge_reach: float | None,
    clearances: Float[Tensor, "batch body"],
    workspace: tuple[Tensor, Tensor] | None = None,
) -> StaticSurface:
    """Return what contact needs beside the static particles (positions, normals, mask).

    ``above`` are points of what hides the surface below it: bodies, and what is driven. Each is projected on the
    tangent plane of the static particle nearest to it, of those whose plane it is not behind: what is seen is outside
    of everything, and near a table's edge the nearest particle may be on the table's side. ``edge_reach`` is in
    spacings of the static particles; null: a surface goes on without end, and there are no footprints. Where
    the sides of the ``workspace`` (its lowest and highest corner, ``batch 1 3``) cut a surface, it goes on beyond them.
    """
    positions, normals, mask = statics
    if edge_reach is None:
        nothing = above[:, :0], above[:, :0], is_above[:, :0]
        return StaticSurface(*nothing, None, clearances)
    oriented = mask & (normals.square().sum(dim=-1) > 0.5)
    index, exists = _nearest_below(above, positions, normals, oriented)
    facing = vectors_of(normals, index)
    heights = ((above - vectors_of(positions, index)) * facing).sum(dim=-1, keepdim=True)
    spacing = point_spacing(positions, mask)
    reach = (edge_reach * spacing)[:, None].expand_as(mask)
    if workspace is not None:
        to_wall = torch.minimum(positions - workspace[0], workspace[1] - positions).amin(dim=-1)
        reach = reach.masked_fill(to_wall < _AT_WALL * reach, torch.inf)
    edges = surface_edges(statics, spacing, reach)
    # A footprint is part of the surface on which it lies: where that ends, it does.
    there, offsets = edges.gathered(index), above - vectors_of(positions, index)
    beside = offsets - heights * facing
    known = exists & is_above & there.include(beside, torch.zeros_like(there.reach))
    left = SurfaceEdges(
        (edge_reach * spacing)[:, None].expand_as(known),
        there.outward,
        there.ends - (beside * there.outward).sum(dim=-1),
    )
    return StaticSurface(
        positions=torch.where(known[..., None], above - heights * facing, 0.0),
        normals=torch.where(known[..., None], facing, 0.0),
        mask=known,
        edges=edges.joined(left),
        clearances=clearances,
    )


def _distances(first: Tensor, second: Tensor) -> Float[Tensor, "batch first second"]:
    """Return those of all pairs (metres), by differences, but without an axis of 3: a third of the memory."""
    return torch.cdist(first, second, compute_mode="donot_use_mm_for_euclid_dist")  # noqa: TID251


def _nearest_below(
    above: Tensor, positions: Tensor, normals: Tensor, usable: Tensor
) -> tuple[Int[Tensor, "batch point"], Bool[Tensor, "batch point"]]:
    """Return the nearest static particle whose tangent plane each point is not behind, and whether there is one."""
    apart = _distances(above, positions)
    heights = torch.einsum("bpi,bsi->bps", above, normals) - (positions * normals).sum(dim=-1)[:, None]
    counts = usable[:, None] & (heights > -_BEHIND)
    least, index = apart.masked_fill(~counts, torch.inf).min(dim=-1)
    return index, torch.isfinite(least)


def static_contacts(
    surface: StaticSurface,
    points: ContactPoints,
    statics: tuple[Tensor, Tensor, Tensor],
    centers: Float[Tensor, "batch body 3"],
    far: float,
) -> Contacts:
    """Measure contact points against the static particles and footprints; resting bodies from where they rest.

    A surface that ends acts on bodies whose centre is in front of it: the side of a table not on what stands on top.
    """
    found = nearest_static_contacts(points.positions, *surface.joined(statics), far, surface.edges)
    is_on = torch.ones_like(found.distances, dtype=torch.bool)
    if surface.edges is not None:
        is_on = _in_front(found, points, centers)
    lowered = found.distances - torch.gather(surface.clearances, 1, points.bodies)
    # Without a surface near, the distance is the farthest there is.
    known = found.normals.square().sum(dim=-1) > 0.5
    return Contacts(
        distances=torch.where(known & is_on, lowered, torch.full_like(found.distances, far)),
        normals=found.normals * is_on[..., None],
        lateral=torch.where(is_on, found.lateral, torch.full_like(found.lateral, far)),
    )


def _in_front(
    found: Contacts, points: ContactPoints, centers: Float[Tensor, "batch body 3"]
) -> Bool[Tensor, "batch point"]:
    """Return whether the centre of each point's body is in front of the plane that the point meets."""
    inward = vectors_of(centers, points.bodies) - points.positions
    return found.distances + (inward * found.normals).sum(dim=-1) > 0


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
    found = on_feet(nearest_static_contacts(points.positions, *statics, far), points, far)
    known = (found.normals.square().sum(dim=-1) > 0.5) & _in_front(found, points, motion.centers)
    belongs = (points.members > 0) & known[:, None]
    gaps, lowest = found.distances[:, None].masked_fill(~belongs, torch.inf).min(dim=-1)
    normals = vectors_of(found.normals, lowest)
    approach = (motion.displacements * normals).sum(dim=-1).abs()
    is_supported = (approach < max_speed) & (gaps < _MOST_CLEARANCE * sizes) & (gaps > -_MOST_SUNK * sizes)
    return torch.where(is_supported, gaps, 0.0), is_supported
