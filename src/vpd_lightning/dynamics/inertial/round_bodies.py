"""Round bodies: ellipsoids touch a surface where their own faces it, whichever of their particles are near it.

A ball of some hundred particles is a polyhedron, and comes to rest where a ball rolls on.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, vectors_of
from vpd_lightning.dynamics.inertial.contact_search import ContactPoints, Contacts, Feet
from vpd_lightning.dynamics.inertial.rigid_motion import cross, rotation_from_spin
from vpd_lightning.dynamics.inertial.surface_edges import SurfaceEdges

_ROUND = 0.1
"""Of its size: a body whose particles are within this of an ellipsoid (root mean square) is one."""

_FEWEST = 20
"""Particles with a normal that it takes to see it."""

_THINNEST = 0.1
"""Of its size: a thinner one is flat, and no ellipsoid."""

_NUM_ROUNDS, _FARTHEST = 2, 2.5
"""Rounds of the fit; after each, particles that are farther off than so many times the error are left out."""

_PULL = 1e-4
"""Weight of the ball around the given centre in the fit; decides what the seen part leaves open."""

_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))

_ON = 0.5
"""Of the height of its centre: a foot that is nearer to a surface is on it."""

_TOUCHING = 1.05
"""Of its size, from the centre: a place that is nearer is at its surface."""

_SAME_SIDE = 0.5
"""Cosine of normals of surfaces between which one foot is enough."""

_IN = 0.5
"""Of its reach: a body whose centre is nearer to a plane does not stand in front of it."""


@torch.no_grad()
def fit_ellipsoids(
    positions: Float[Tensor, "batch moving 3"],
    normals: Float[Tensor, "batch moving 3"],
    bodies: Float[Tensor, "batch body moving"],
    centers: Float[Tensor, "batch body 3"],
) -> tuple[Float[Tensor, "batch body 3"], Float[Tensor, "batch body 3 3"]]:
    """Fit an ellipsoid to the tangent planes of each body (its particles and their normals).

    Returns centres (metres) and shapes: matrices whose eigenvalues are the squares of the semi-axes. A body that is no
    ellipsoid keeps the given centre, and its shape is zero.

    A plane n . x = h touches the ellipsoid with centre c and matrix M where (h - n . c)^2 = n . M n: linear in c and in
    M - c c^T, so that one least squares finds both, also where only a part is seen. Of this and the fit around the
    given centre the nearer one is taken: a capsule is no ellipsoid, and its free fit is too flat. Then once more
    without the particles that are farthest off.
    """
    dtype = positions.dtype
    positions, normals, bodies, start = (values.double() for values in (positions, normals, bodies, centers))
    known = bodies * (normals.square().sum(dim=-1) > 0.5)[:, None]
    local = positions[:, None] - start[:, :, None]
    size = (_shares(known) * local.square().sum(dim=-1)).sum(dim=-1).clamp(min=1e-18).sqrt()
    local = local / size[..., None, None]
    for _ in range(_NUM_ROUNDS):
        share = _shares(known)
        free, fixed = (_fitted(local, normals, share, is_free) for is_free in (True, False))
        nearer = _rms(free.misses(local), share) < _rms(fixed.misses(local), share)
        fit = free.where(nearer, fixed)
        misses = fit.misses(local)
        error = _rms(misses, share)
        known = known * (misses.abs() < _FARTHEST * error[..., None])
    is_solid = torch.linalg.eigvalsh(fit.shapes).amin(dim=-1) > _THINNEST**2
    is_round = is_solid & (known.sum(dim=-1) >= _FEWEST) & (error < _ROUND)
    scale = size[..., None]
    found = torch.where(is_round[..., None], start + scale * fit.offsets, start)
    shapes = torch.where(is_round[..., None, None], fit.shapes * scale[..., None].square(), 0.0)
    return found.to(dtype), shapes.to(dtype)


class _Fit(NamedTuple):
    """Ellipsoids in units of a size, from a centre."""

    offsets: Float[Tensor, "batch body 3"]
    shapes: Float[Tensor, "batch body 3 3"]

    def where(self, chosen: Bool[Tensor, "batch body"], others: "_Fit") -> "_Fit":
        """Return these where they are chosen, else the others."""
        wide = chosen[..., None]
        return _Fit(
            torch.where(wide, self.offsets, others.offsets), torch.where(wide[..., None], self.shapes, others.shapes)
        )

    def misses(self, local: Float[Tensor, "batch body particle 3"]) -> Float[Tensor, "batch body particle"]:
        """Return by how much of its size each particle is outside."""
        values, axes = torch.linalg.eigh(self.shapes)
        along = (local - self.offsets[:, :, None]) @ axes
        return (along / values.clamp(min=_THINNEST**2).sqrt()[:, :, None]).norm(dim=-1) - 1


def _fitted(local: Tensor, normals: Tensor, share: Tensor, is_free: bool) -> _Fit:
    """Solve for shape and, where it is free, centre; what is left open is as of a ball."""
    heights = (local * normals[:, None]).sum(dim=-1)
    products = [(1 if i == j else 2) * normals[:, None, :, i] * normals[:, None, :, j] for i, j in _PAIRS]
    rows = torch.stack([values.expand_as(heights) for values in products], dim=-1)
    ball = (share * heights).sum(dim=-1).square()
    guess = torch.stack([ball, ball, ball, 0 * ball, 0 * ball, 0 * ball], dim=-1)
    if is_free:
        rows = torch.cat([rows, 2 * heights[..., None] * normals[:, None]], dim=-1)
        guess = nn.functional.pad(guess, (0, 3))
    weighted = rows * share[..., None]
    pull = _PULL * torch.eye(rows.shape[-1], dtype=rows.dtype, device=rows.device)
    right = weighted.mT @ heights.square()[..., None] + _PULL * guess[..., None]
    found = torch.linalg.solve(weighted.mT @ rows + pull, right)[..., 0]
    shapes = found[..., [0, 3, 4, 3, 1, 5, 4, 5, 2]].unflatten(-1, (3, 3))
    offsets = found[..., 6:] if is_free else torch.zeros_like(found[..., :3])
    return _Fit(offsets, shapes + offsets[..., :, None] * offsets[..., None, :])


def _shares(weights: Tensor) -> Tensor:
    return weights / weights.sum(dim=-1, keepdim=True).clamp(min=1)


def _rms(values: Tensor, share: Tensor) -> Tensor:
    return (share * values.square()).sum(dim=-1).sqrt()


@torch.no_grad()
def rolling(motion: BodyMotion, feet: Feet | None, is_held: Bool[Tensor, "batch body"]) -> BodyMotion:
    """Return the motion with each round body that is on a surface rolling, but for those that something holds.

    Of a smooth body of few colours two frames show where it went, hardly how it turned. What rolls on its own soon
    turns so that its foot stands still.
    """
    if feet is None:
        return motion
    count = motion.centers.shape[1]
    normals, distances = feet.contacts.normals[:, :count], feet.contacts.distances[:, :count]
    height = ((motion.centers - feet.positions[:, :count]) * normals).sum(dim=-1)
    is_on = (normals.square().sum(dim=-1) > 0.5) & (distances.abs() < _ON * height)
    about = (motion.spins * normals).sum(dim=-1, keepdim=True) * normals
    spins = cross(normals, motion.displacements) / height.clamp(min=1e-9)[..., None] + about
    return replace(motion, spins=torch.where((is_on & ~is_held)[..., None], spins, motion.spins))


@torch.no_grad()
def touches(
    shapes: Float[Tensor, "batch body 3 3"],
    centers: Float[Tensor, "batch body 3"],
    places: Float[Tensor, "batch any 3"],
    mask: Bool[Tensor, "batch any"],
) -> Bool[Tensor, "batch body"]:
    """Return which round bodies one of some places (metres) is at or in."""
    is_round = shapes.diagonal(dim1=-2, dim2=-1).sum(dim=-1) > 0
    eye = torch.eye(3, dtype=shapes.dtype, device=shapes.device)
    inverse = torch.linalg.inv(torch.where(is_round[..., None, None], shapes, eye))
    offsets = places[:, None] - centers[:, :, None]
    square = torch.einsum("bkpi,bkij,bkpj->bkp", offsets, inverse, offsets)
    return is_round & (mask[:, None] & (square < _TOUCHING**2)).any(dim=-1)


def with_feet(
    points: ContactPoints,
    shapes: Float[Tensor, "batch body 3 3"],
    motion: BodyMotion,
    statics: tuple[Tensor, Tensor, Tensor],
    edges: SurfaceEdges | None,
    clearances: Float[Tensor, "batch body"],
    far: float,
) -> ContactPoints:
    """Return the points and behind them the feet of each round body: where it faces the two surfaces next to it.

    Beyond the edge of a surface (None: it has none) a foot faces the edge. ``clearances`` are how far above a surface
    a body's foot seems to be when it stands there. Forces act where the foot is in the middle of the step: at its
    beginning, an ellipsoid would gain energy while it rolls.
    """
    positions, normals, mask = statics
    if positions.shape[1] == 0 or not bool(shapes.any()):
        return points
    centers = motion.centers
    with torch.no_grad():
        oriented = mask & (normals.square().sum(dim=-1) > 0.5)
        offsets = centers[:, :, None] - positions[:, None]
        heights = (offsets * normals[:, None]).sum(dim=-1)
        reach = torch.einsum("bsi,bkij,bsj->bks", normals, shapes, normals).clamp(min=1e-18).sqrt()
        square = offsets.square().sum(dim=-1)
        is_round = shapes.diagonal(dim1=-2, dim2=-1).sum(dim=-1) > 0
        # Not those that a body is deep in: what is beyond a table's edge is beside the table, not in its side.
        usable = oriented[:, None] & (heights > _IN * reach) & (square < far**2) & is_round[..., None]
        nearest = square.masked_fill(~usable, torch.inf).argmin(dim=-1)
        alike = (normals[:, None] * vectors_of(normals, nearest)[:, :, None]).sum(dim=-1) > _SAME_SIDE
        second = square.masked_fill(~usable | alike, torch.inf).argmin(dim=-1)
        index = torch.cat([nearest, second], dim=1)
        known = torch.cat([usable, usable & ~alike], dim=1).any(dim=-1)
    bodies = torch.arange(centers.shape[1], device=centers.device).repeat(2)
    contacts = _facing(shapes[:, bodies], centers[:, bodies], positions, normals, index, edges)
    turn = rotation_from_spin(motion.spins / 2)
    halfway = turn @ shapes @ turn.mT
    places = centers[:, bodies] + _arms(halfway[:, bodies], contacts.normals)
    contacts = Contacts(
        (contacts.distances - clearances[:, bodies]).masked_fill(~known, far),
        contacts.normals * known[..., None],
        contacts.lateral.masked_fill(~known, far),
    )
    eye = torch.eye(centers.shape[1], dtype=shapes.dtype, device=shapes.device)
    return ContactPoints(
        torch.cat([points.positions, places], dim=1),
        torch.cat([points.normals, torch.zeros_like(places)], dim=1),
        torch.cat([points.members, eye[:, bodies] * known[:, None]], dim=2),
        Feet(points.positions.shape[1], places, contacts, is_round),
    )


def _facing(
    shapes: Float[Tensor, "batch foot 3 3"],
    centers: Float[Tensor, "batch foot 3"],
    positions: Float[Tensor, "batch particle 3"],
    normals: Float[Tensor, "batch particle 3"],
    index: Int[Tensor, "batch foot"],
    edges: SurfaceEdges | None,
) -> Contacts:
    """Return how ellipsoids face the planes of some particles, or the edges beyond which they are."""
    planes, offsets = vectors_of(normals, index), centers - vectors_of(positions, index)
    heights = (offsets * planes).sum(dim=-1, keepdim=True)
    beside = offsets - heights * planes
    gap = heights * planes  # from where the surface is nearest
    towards, is_on = planes, torch.ones_like(index, dtype=torch.bool)
    if edges is not None:
        there = edges.gathered(index)
        beyond = torch.relu((beside * there.outward).sum(dim=-1) - there.ends)[..., None]
        beside, gap = beside - beyond * there.outward, gap + beyond * there.outward
        length = gap.square().sum(dim=-1, keepdim=True).clamp(min=1e-12).sqrt()
        towards = torch.where(beyond > 0, gap / length, planes)
        is_on = beside.square().sum(dim=-1) < there.reach.square()
    distances = ((gap + _arms(shapes, towards)) * towards).sum(dim=-1)
    lateral = beside.square().sum(dim=-1).clamp(min=1e-12).sqrt()
    return Contacts(distances, towards * is_on[..., None], lateral)


def _arms(shapes: Tensor, normals: Tensor) -> Float[Tensor, "batch foot 3"]:
    """Return from the centres where ellipsoids face surfaces with these normals; of no ellipsoid zero."""
    inward = (shapes @ normals[..., None])[..., 0]
    return -inward / (inward * normals).sum(dim=-1, keepdim=True).clamp(min=1e-18).sqrt()


def on_feet(contacts: Contacts, points: ContactPoints, far: float) -> Contacts:
    """Return the contacts with those of the feet, and without those of all other points of round bodies."""
    feet = points.feet
    if feet is None:
        return contacts
    covered = torch.gather(feet.is_round, 1, points.bodies)
    covered[:, feet.slots] = False
    found = [
        torch.cat([values[:, : feet.first], own, values[:, feet.slots.stop :]], dim=1)
        for values, own in zip(contacts.parts(), feet.contacts.parts(), strict=True)
    ]
    return Contacts(found[0].masked_fill(covered, far), found[1] * ~covered[..., None], found[2])
