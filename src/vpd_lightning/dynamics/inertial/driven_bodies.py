"""Contact with what is driven: rigid parts whose motion is given, as bodies of infinite mass."""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, Inertia, vectors_of
from vpd_lightning.dynamics.inertial.contact_search import BodyContacts, ContactPoints, Contacts
from vpd_lightning.dynamics.inertial.materials import Materials
from vpd_lightning.dynamics.inertial.nearest import nearest_usable
from vpd_lightning.dynamics.inertial.resting import rows_of
from vpd_lightning.dynamics.inertial.rigid_motion import fit_twists, weighted_sum
from vpd_lightning.geometry.spacing import point_spacing
from vpd_lightning.types import Driven

_REACH = 1.5
"""Spacings beside a point within which it still locates its surface."""

_NEAR_SPACINGS = 1.0
"""Of the driven points, from a body: nearer, its own points may meet the surface between them."""

_STEP_SHARE = 0.25
"""Of the size of a body: what a driven point moves farther in a step is looked at in parts, lest it jump over it."""

_MOST_PARTS = 64


@dataclass(frozen=True)
class DrivenBodies:
    """The rigid parts of what is driven in one step; positions (metres) from the memory's origin."""

    positions: Float[Tensor, "batch driven 3"]
    displacements: Float[Tensor, "batch driven 3"]
    normals: Float[Tensor, "batch driven 3"]
    mask: Bool[Tensor, "batch driven"]
    groups: Int64[Tensor, "batch driven"]
    members: Float[Tensor, "batch group driven"]
    motion: BodyMotion
    spacing: Float[Tensor, " batch"]


@dataclass(frozen=True)
class Surface:
    """What a driven point may push: all particles of bodies and, where these are guessed, their mirror images."""

    positions: Float[Tensor, "batch point 3"]
    normals: Float[Tensor, "batch point 3"]
    own: Int64[Tensor, "batch point"]
    is_usable: Bool[Tensor, "batch point"]
    spacing: Float[Tensor, " batch"]
    sizes: Float[Tensor, "batch body"]  # metres
    radii: Float[Tensor, "batch body"]  # metres, of the spheres about their centres that hold all usable points


@dataclass(frozen=True)
class WithDriven:
    """What the contact solver works on, with driven parts behind the bodies."""

    points: ContactPoints
    static: Contacts
    between: BodyContacts


def driven_bodies(driven: Driven, origin: Float[Tensor, "batch 1 3"]) -> DrivenBodies:
    """Return the parts and the rigid motion of each in this step, fitted to that of its points."""
    following = driven.advanced()
    mask = driven.mask[..., None]
    positions = torch.where(mask, driven.positions - origin, 0.0)
    displacements = torch.where(mask, following.positions - driven.positions, 0.0)
    numbers = torch.arange(int(driven.groups.max()) + 1, device=driven.groups.device)
    members = ((driven.groups[:, None] == numbers[:, None]) & driven.mask[:, None]).to(positions.dtype)
    shares = members / members.sum(dim=-1, keepdim=True).clamp(min=1)
    fitted = fit_twists(positions + displacements, displacements, shares)
    eye = torch.eye(3, dtype=positions.dtype, device=positions.device).expand(*fitted.spins.shape, 3)
    motion = BodyMotion(
        centers=weighted_sum(shares, positions),
        displacements=fitted.displacements,
        spins=fitted.spins,
        stretches=eye,
        strains=torch.zeros_like(eye),
    )
    return DrivenBodies(
        positions=positions,
        displacements=displacements,
        normals=torch.where(mask, driven.normals, 0.0),
        mask=driven.mask,
        groups=driven.groups,
        members=members,
        motion=motion,
        spacing=point_spacing(positions, driven.mask),
    )


def meet(
    bodies: DrivenBodies,
    surface: Surface,
    motion: BodyMotion,
    points: ContactPoints,
    static: Contacts,
    between: BodyContacts | None,
) -> WithDriven | None:
    """Return points and contacts with those of what is driven; None where none of it can touch a body in this step.

    ``motion`` is that of the bodies before any contact. A driven point meets the tangent plane of the body particle
    that was nearest to it, a body's point that of the nearest driven point, where it would be below that after the
    step; long steps are looked at in parts.
    """
    own = points.bodies
    target, is_met, nearest, touches = _met(bodies, surface, motion, points)
    if not bool(is_met.any() | touches.any()):
        return None
    count, num_driven = points.positions.shape[1], bodies.positions.shape[1]
    num_bodies, num_groups = points.members.shape[1], bodies.members.shape[1]
    taken = {name: vectors_of(getattr(surface, name), target) for name in ("positions", "normals")}
    bodies_of_target = torch.gather(surface.own, 1, target)
    is_own = torch.arange(num_bodies, device=own.device)[:, None] == bodies_of_target[:, None]
    members = points.members.new_zeros(len(own), num_bodies + num_groups, 2 * count + 2 * num_driven)
    members[:, :num_bodies, :count] = points.members
    members[:, :num_bodies, count : 2 * count] = points.members
    members[:, num_bodies:, 2 * count : 2 * count + num_driven] = bodies.members
    members[:, :num_bodies, 2 * count + num_driven :] = is_own.to(members)
    here = torch.arange(num_driven, device=own.device).expand(len(own), -1)
    first = between or BodyContacts(torch.zeros_like(own), torch.zeros_like(touches))
    # Behind the points once more the same, for what they have to do with what is driven; then that, and its targets.
    others = [first.other, nearest + 2 * count, here + 2 * count + num_driven, here]
    known = [first.known, touches, is_met, torch.zeros_like(is_met)]
    return WithDriven(
        points=ContactPoints(
            torch.cat([points.positions, points.positions, bodies.positions, taken["positions"]], dim=1),
            torch.cat([points.normals, points.normals, bodies.normals, taken["normals"]], dim=1),
            members,
            points.feet,
        ),
        static=Contacts(*(_padded(values, members.shape[-1]) for values in static.parts())),
        between=BodyContacts(torch.cat(others, dim=1), torch.cat(known, dim=1)),
    )


def is_touched(
    bodies: DrivenBodies, surface: Surface, motion: BodyMotion, points: ContactPoints
) -> Bool[Tensor, " batch"]:
    """Return in which members ``meet`` finds something."""
    _, is_met, _, touches = _met(bodies, surface, motion, points)
    return is_met.any(dim=1) | touches.any(dim=1)


def is_pushed(bodies: DrivenBodies, surface: Surface, motion: BodyMotion) -> Bool[Tensor, " batch"]:
    """Return in which members a driven point comes near a body in this step; between them it may touch."""
    return _met_by_driven(bodies, surface, motion, margin=_NEAR_SPACINGS)[1].any(dim=1)


def joined_motion(motion: BodyMotion, driven: BodyMotion) -> BodyMotion:
    """Return the motion of bodies with that of driven parts behind."""
    names = [item.name for item in fields(BodyMotion)]
    return BodyMotion(*(torch.cat([getattr(motion, name), getattr(driven, name)], dim=1) for name in names))


def joined_inertia(inertia: Inertia, count: int) -> Inertia:
    """Return the inertia with that of driven parts behind: nothing turns or stretches them."""

    def joined(values: Tensor) -> Tensor:
        return torch.cat([values, values.new_zeros(len(values), count, *values.shape[2:])], dim=1)

    return Inertia(joined(inertia.inverse_turning), joined(inertia.inverse_moments), joined(inertia.softness))


def joined_materials(materials: Materials, friction: Float[Tensor, ""], count: int) -> Materials:
    """Return the materials with those of driven parts behind: rigid, without a bounce of their own."""

    def joined(values: Tensor, value: Tensor | float) -> Tensor:
        return torch.cat([values, torch.ones_like(values[:, :1]).expand(-1, count, -1) * value], dim=1)

    return replace(
        materials,
        friction=joined(materials.friction, friction),
        restitution=joined(materials.restitution, 0.0),
        density=joined(materials.density, 1.0),
        softness=joined(materials.softness, 0.0),
        stiffness=joined(materials.stiffness, 0.0),
        damping=joined(materials.damping, 0.0),
    )


def _met(
    bodies: DrivenBodies, surface: Surface, motion: BodyMotion, points: ContactPoints
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return targets of driven points and whether they meet them, and the same of the points of bodies."""
    depth = torch.gather(surface.sizes, 1, points.bodies) / 3
    return *_met_by_driven(bodies, surface, motion), *_met_by_bodies(bodies, points, motion, depth)


@torch.no_grad()
def _met_by_driven(
    bodies: DrivenBodies, surface: Surface, motion: BodyMotion, margin: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Return the surface point whose tangent plane each driven point meets, and whether it meets one in this step.

    With a ``margin`` (spacings of the driven points) it is enough to come that near. Members of the batch in which
    nothing is near are not looked at.
    """
    target, is_met = torch.zeros_like(bodies.groups), torch.zeros_like(bodies.mask)
    count = len(is_met)
    rows = _may_meet(bodies, surface, motion, margin).nonzero()[:, 0]
    if len(rows) == 0:
        return target, is_met
    if len(rows) == count:
        return _met_nearby(bodies, surface, motion, margin)
    found = _met_nearby(*rows_of((bodies, surface, motion), rows, count), margin)
    return target.index_copy(0, rows, found[0]), is_met.index_copy(0, rows, found[1])


def _may_meet(bodies: DrivenBodies, surface: Surface, motion: BodyMotion, margin: float) -> Bool[Tensor, " batch"]:
    """Return in which members a body's sphere comes as near to the box around what is driven as points must to meet.

    Both are those of the whole step.
    """
    deformation = motion.deformation()
    turned = motion.spins.norm(dim=-1) * deformation.flatten(2).norm(dim=-1)
    stretched = (deformation - torch.eye(3).to(deformation)).flatten(2).norm(dim=-1)
    reach = surface.radii * (1 + turned + stretched) + motion.displacements.norm(dim=-1)
    low, high = _swept_box(bodies)
    beyond = torch.maximum(low[:, None] - motion.centers, motion.centers - high[:, None]).clamp(min=0)
    is_near = beyond.norm(dim=-1) <= reach + _reach(bodies, surface, margin)[:, None]
    return (is_near & (surface.radii > 0)).any(dim=1)


def _reach(bodies: DrivenBodies, surface: Surface, margin: float) -> Float[Tensor, " batch"]:
    """Return how far apart points may be that meet (metres)."""
    above = margin * bodies.spacing
    return _REACH * surface.spacing + above + torch.maximum(above, surface.sizes.amax(dim=1) / 3)


def _swept_box(bodies: DrivenBodies) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch 3"]]:
    """Return the lowest and the highest corner of the box around what is driven, before and after the step."""
    moved = torch.stack([bodies.positions, bodies.positions + bodies.displacements], dim=1)
    missing = ~bodies.mask[:, None, :, None]
    return (
        moved.masked_fill(missing, torch.inf).amin(dim=(1, 2)),
        moved.masked_fill(missing, -torch.inf).amax(dim=(1, 2)),
    )


def _met_nearby(bodies: DrivenBodies, surface: Surface, motion: BodyMotion, margin: float) -> tuple[Tensor, Tensor]:
    """Look at every pair; see ``_met_by_driven``."""
    moves = motion.carried(surface.positions, surface.own) - surface.positions
    # Each member has a number of parts of its own: a batch equals its members.
    fastest = bodies.displacements.norm(dim=-1).amax(dim=1) + (moves.norm(dim=-1) * surface.is_usable).amax(dim=1)
    # Points that are farther from the driven ones than this meet none of them, nor hide a nearer one that does.
    low, high = (corner[:, None] for corner in _swept_box(bodies))
    far = (_reach(bodies, surface, margin) + fastest)[:, None, None]
    usable = surface.is_usable & ((surface.positions > low - far) & (surface.positions < high + far)).all(dim=-1)
    smallest = (_STEP_SHARE * surface.sizes.amin(dim=1)).clamp(min=1e-6)
    num_parts = (fastest / smallest).ceil().clamp(1, _MOST_PARTS)[:, None, None]
    target = torch.zeros_like(bodies.groups)
    is_met = torch.zeros_like(bodies.mask)
    above = margin * bodies.spacing[:, None]
    reach = (_REACH * surface.spacing[:, None] + above).square()
    for part in range(int(num_parts.max())):
        # The nearest point before a part of the step is on the side from which the surface is entered; the one nearest
        # after it may be on another face.
        places, queries = (
            start + part / num_parts * step
            for start, step in ((surface.positions, moves), (bodies.positions, bodies.displacements))
        )
        index, exists = nearest_usable(queries, places, usable)
        offsets = queries - vectors_of(places, index) + (bodies.displacements - vectors_of(moves, index)) / num_parts
        height = (offsets * vectors_of(surface.normals, index)).sum(dim=-1)
        beside = offsets.square().sum(dim=-1) - height.square()
        depth = torch.gather(surface.sizes, 1, torch.gather(surface.own, 1, index)) / 3
        inside = (
            exists & bodies.mask & (beside < reach) & (height < above) & (height > -depth) & (part < num_parts[:, 0])
        )
        target = torch.where(inside & ~is_met, index, target)
        is_met = is_met | inside
    return target, is_met


@torch.no_grad()
def _met_by_bodies(
    bodies: DrivenBodies, points: ContactPoints, motion: BodyMotion, depth: Float[Tensor, "batch probe"]
) -> tuple[Tensor, Tensor]:
    """Return the driven point whose tangent plane each point of a body meets, and whether it meets one."""
    there = motion.carried(points.positions, points.bodies)
    usable = bodies.mask & (bodies.normals.square().sum(dim=-1) > 0.5)
    nearest, exists = nearest_usable(points.positions, bodies.positions, usable)
    offsets = there - vectors_of(bodies.positions + bodies.displacements, nearest)
    height = (offsets * vectors_of(bodies.normals, nearest)).sum(dim=-1)
    beside = offsets.square().sum(dim=-1) - height.square()
    inside = (beside < (_REACH * bodies.spacing[:, None]).square()) & (height < 0) & (height > -depth)
    return nearest, exists & points.members.any(dim=1) & inside


def _padded(values: Tensor, count: int) -> Tensor:
    """Return the values with zeros behind: a normal of zero is no contact."""
    return torch.cat([values, values.new_zeros(len(values), count - values.shape[1], *values.shape[2:])], dim=1)
