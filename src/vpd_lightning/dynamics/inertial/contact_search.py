"""Where points of bodies may touch what stands still or another body."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import vectors_of
from vpd_lightning.dynamics.inertial.nearest import nearest_usable
from vpd_lightning.dynamics.inertial.surface_edges import SurfaceEdges


@dataclass(frozen=True)
class Contacts:
    """For each probe: signed distance (metres, positive outside), surface normal, and lateral offset (metres)."""

    distances: Float[Tensor, "batch probe"]
    normals: Float[Tensor, "batch probe 3"]
    lateral: Float[Tensor, "batch probe"]

    def first(self, count: int) -> "Contacts":
        """Return those of the first probes."""
        return Contacts(self.distances[:, :count], self.normals[:, :count], self.lateral[:, :count])

    def parts(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.distances, self.normals, self.lateral


@dataclass(frozen=True)
class ContactPoints:
    """Points of bodies that may touch something; ``members`` is 1 where a point belongs to a body, else 0.

    The ``feet`` are those of round bodies (``round_bodies``): they stay below while the body turns.
    """

    positions: Float[Tensor, "batch probe 3"]
    normals: Float[Tensor, "batch probe 3"]
    members: Float[Tensor, "batch body probe"]
    feet: "Feet | None" = None

    @cached_property
    def bodies(self) -> Int[Tensor, "batch probe"]:
        """The body of each point; 0 where it has none."""
        return self.members.argmax(dim=1)


@dataclass(frozen=True)
class Feet:
    """Contacts of round bodies: of all, then a second one of all; ``first`` is the number of the first such point."""

    first: int
    positions: Float[Tensor, "batch foot 3"]
    contacts: Contacts
    is_round: Bool[Tensor, "batch body"]

    @property
    def slots(self) -> slice:
        """Where they are among the points."""
        return slice(self.first, self.first + self.positions.shape[1])


@dataclass(frozen=True)
class BodyContacts:
    """For each probe: the nearest probe of another body whose normal is known, and whether it is valid."""

    other: Int[Tensor, "batch probe"]
    known: Bool[Tensor, "batch probe"]


def nearest_static_contacts(
    probes: Float[Tensor, "batch probe 3"],
    static_positions: Float[Tensor, "batch particle 3"],
    static_normals: Float[Tensor, "batch particle 3"],
    static_mask: Bool[Tensor, "batch particle"],
    far: float,
    edges: SurfaceEdges | None = None,
) -> Contacts:
    """Measure each probe against the tangent plane of its nearest static particle whose normal is known.

    The point-to-plane distance is exact on flat surfaces however sparse the particles are. Without any static
    particle, beyond ``far`` metres, or beside the nearest one's surface where that ends (``edges``; None: nowhere), the
    distance is ``far`` and the normal zero: no contact.
    """
    oriented = static_mask & (static_normals.square().sum(dim=-1) > 0.5)
    index, exists = nearest_usable(probes, static_positions, oriented)
    normals, offsets = vectors_of(static_normals, index), probes - vectors_of(static_positions, index)
    distances = (offsets * normals).sum(dim=-1)
    lateral = (offsets - distances[..., None] * normals).square().sum(dim=-1).clamp(min=1e-12).sqrt()
    known = exists & (offsets.square().sum(dim=-1) < far**2)
    if edges is not None:
        known = known & edges.gathered(index).include(offsets, lateral)
    return Contacts(
        distances=torch.where(known, distances, torch.full_like(distances, far)),
        normals=normals * known[..., None],
        lateral=torch.where(known, lateral, torch.full_like(lateral, far)),
    )


@torch.no_grad()
def nearest_body_contacts(
    points: ContactPoints,
    reach: Float[Tensor, " batch"],
    max_depth: Float[Tensor, "batch probe"],
) -> BodyContacts:
    """Find for each probe the surface of another body that it may touch.

    A probe that lies beside the surface's nearest point by more than ``reach`` (metres) is not above that surface, and
    one deeper below it than its ``max_depth`` came from the other side.
    """
    positions, normals, is_owned = points.positions, points.normals, points.members.any(dim=1)
    bodies = torch.where(is_owned, points.bodies, -1)
    oriented = is_owned & (normals.square().sum(dim=-1) > 0.5)
    other, exists = nearest_usable(positions, positions, oriented, (bodies, bodies))
    exists = exists & is_owned
    offset = positions - vectors_of(positions, other)
    height = (offset * vectors_of(normals, other)).sum(dim=-1)
    beside = offset.square().sum(dim=-1) - height.square()
    known = exists & (beside < reach[:, None].square()) & (height > -max_depth)
    return BodyContacts(other, known)
