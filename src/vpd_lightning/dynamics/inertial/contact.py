"""Contact: bodies kept out of what stands still and out of one another, with friction and bounce."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, Inertia, Push, matrices_of, vectors_of
from vpd_lightning.dynamics.inertial.contact_search import BodyContacts, ContactPoints, Contacts
from vpd_lightning.dynamics.inertial.materials import Materials
from vpd_lightning.dynamics.inertial.rigid_motion import cross, rotate, rotation_from_spin


@dataclass(frozen=True)
class Resolved:
    """A step after contact: how far bodies go in it, and with what velocity they go on from it."""

    step: BodyMotion
    onward: BodyMotion
    touching: Bool[Tensor, "batch body 1"]

    def first(self, count: int) -> "Resolved":
        """Return that of the first bodies."""
        return Resolved(self.step.first(count), self.onward.first(count), self.touching[:, :count])

    def guided(self, before: BodyMotion, share: Float[Tensor, "batch body 1"]) -> "Resolved":
        """Return it with that share of the motion ``before``, which goes on whatever acted on it."""
        return replace(self, step=self.step.towards(before, share), onward=self.onward.towards(before, share))


@dataclass(frozen=True)
class _Touch:
    """One resolved contact of each body, to be looked at again for the velocity after the impact."""

    arms: Float[Tensor, "batch body 3"]
    normals: Float[Tensor, "batch body 3"]
    approach: Float[Tensor, "batch body 1"]
    is_active: Bool[Tensor, "batch body 1"]


@dataclass(frozen=True)
class _Facing:
    """The points that may touch another body, and those there: most points of a step have none, and are left out."""

    own: Int[Tensor, "batch near"]
    offsets: Float[Tensor, "batch near 3"]
    other: Int[Tensor, "batch near"]  # the other body
    other_offsets: Float[Tensor, "batch near 3"]
    other_normals: Float[Tensor, "batch near 3"]
    usable: Bool[Tensor, "batch body body near"]


@dataclass(frozen=True)
class Pairs:
    """One contact of every ordered pair of bodies; those that do not touch are inactive."""

    first: Int[Tensor, "batch pair"]
    second: Int[Tensor, "batch pair"]
    first_arms: Float[Tensor, "batch pair 3"]
    second_arms: Float[Tensor, "batch pair 3"]
    normals: Float[Tensor, "batch pair 3"]
    approach: Float[Tensor, "batch pair 1"]
    is_active: Bool[Tensor, "batch pair 1"]

    def sides(self) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        return (self.first, self.first_arms), (self.second, self.second_arms)

    def relative(self, motion: BodyMotion) -> Float[Tensor, "batch pair 3"]:
        """Return the velocity (metres per step) of the first body's point as seen from the second's."""
        first, second = (velocity_at(_gathered(as_push(motion), index), arms) for index, arms in self.sides())
        return first - second

    @property
    def touching(self) -> Bool[Tensor, "batch body 1"]:
        """Whether each body is in any active pair."""
        count = round(self.first.shape[1] ** 0.5)
        active = self.is_active.view(-1, count, count)
        return (active.any(dim=1) | active.any(dim=2))[..., None]


class ContactSolver:
    """Corrects the motion of one step so that no probe penetrates a static surface or another body.

    Position-based dynamics (Mueller et al. 2007, 2020): each round takes the deepest probe of each body and applies
    the smallest impulse at that point that resolves it, to displacement, spin and stretch alike, and a friction impulse
    of at most the friction coefficient times that (Coulomb). Bodies push each other with equal and opposite impulses,
    so that momentum is kept. The velocity carried to the next step has no component into the surface; of the approach
    speed above ``rest_speed`` (metres per step) the share ``restitution`` is given back. Probes that were deeper than
    ``max_depth`` (metres) before the step are left alone: their surface is not to be trusted.

    The last ``num_driven`` bodies are driven parts of infinite mass. They move fast and nothing takes their impulse, so
    a push at the deepest probe alone would turn what they meet face to face: it acts at the mean of all probes that
    penetrate, the deeper ones more.
    """

    def __init__(
        self,
        *,
        points: ContactPoints,
        centers: Float[Tensor, "batch body 3"],
        inertia: Inertia,
        materials: Materials,
        masses: Float[Tensor, "batch body 1"],
        rest_speed: float,
        num_driven: int = 0,
    ):
        self.points, self.own = points, points.bodies
        self.offsets = points.positions - vectors_of(centers, self.own)
        self.inertia, self.materials, self.masses, self.rest_speed = inertia, materials, masses, rest_speed
        self.num_driven = num_driven

    def resolve(
        self,
        free: BodyMotion,
        static: Contacts,
        between: BodyContacts | None,
        *,
        num_iterations: int,
        max_depth: float,
    ) -> Resolved:
        """Return the step without penetration; ``static`` describes what stands still near each point."""
        touchable = self._touchable(static, max_depth)
        motion, touches = free, []
        touching = torch.zeros_like(self.masses, dtype=torch.bool)
        pairs: list[Pairs] = []
        facing = None if between is None else self._facing(between)
        for _ in range(num_iterations):
            if facing is not None:
                motion, pair = self._part(motion, free, facing)
                pairs.append(pair)
                touching = touching | pair.touching
            motion, touch = self._lift(motion, free, static, touchable)
            touches.append(touch)
            touching = touching | touch.is_active
        onward = motion
        for pair in pairs:
            onward = self._bounce_apart(onward, pair)
        for touch in touches:
            onward = self._bounce(onward, touch)
        return Resolved(motion, onward, touching)

    def _touchable(self, static: Contacts, max_depth: float) -> Bool[Tensor, "batch body probe"]:
        known = (static.normals.square().sum(dim=-1) > 0.5) & (static.distances > -max_depth)
        return (self.points.members > 0) & known[:, None]

    def _lift(
        self, motion: BodyMotion, free: BodyMotion, contacts: Contacts, touchable: Tensor
    ) -> tuple[BodyMotion, _Touch]:
        """Lift the deepest point of each body out of what stands still, and slow its sliding."""
        deepest, normal, arm, move = self._deepest(motion, contacts, touchable)
        lift = torch.relu(-deepest) / self.inertia.response(arm, normal)
        push = self.inertia.push(arm, lift * normal)
        motion = motion.pushed(push)

        move = move + velocity_at(push, arm)
        sliding = move - (move * normal).sum(dim=-1, keepdim=True) * normal
        speed = sliding.square().sum(dim=-1, keepdim=True).clamp(min=1e-12).sqrt()
        direction = sliding / speed
        stop = speed / self.inertia.response(arm, direction)
        drag = -torch.minimum(stop, self.materials.friction * lift) * direction
        motion = motion.pushed(self.inertia.push(arm, drag))
        approach = -(velocity_at(as_push(free), arm) * normal).sum(dim=-1, keepdim=True)
        return motion, _Touch(arm, normal, approach, (lift > 0) & torch.isfinite(deepest))

    def _deepest(
        self, motion: BodyMotion, contacts: Contacts, touchable: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return distance, normal, arm and motion of the point of each body that is deepest after a motion."""
        turned = motion.turned(self.offsets, self.own)
        moves = vectors_of(motion.displacements, self.own) + turned - self.offsets
        if self.points.feet is not None:  # they stay where they are, and the body's surface moves on through them
            feet = self.points.feet.slots
            arms, push = self.offsets[:, feet], _gathered(as_push(motion), self.own[:, feet])
            turned = torch.cat([turned[:, : feet.start], arms, turned[:, feet.stop :]], dim=1)
            moves = torch.cat([moves[:, : feet.start], velocity_at(push, arms), moves[:, feet.stop :]], dim=1)
        ahead = contacts.distances + (moves * contacts.normals).sum(dim=-1)
        deepest, probe = ahead[:, None].masked_fill(~touchable, torch.inf).min(dim=-1)
        normal, arm, move = (vectors_of(values, probe) for values in (contacts.normals, turned, moves))
        return deepest[..., None], normal, arm, move

    def _bounce(self, motion: BodyMotion, touch: _Touch) -> BodyMotion:
        """Give back a share of the approach, or at least take all of it away."""
        speed = (velocity_at(as_push(motion), touch.arms) * touch.normals).sum(dim=-1, keepdim=True)
        wanted = self.materials.restitution * torch.relu(touch.approach - self.rest_speed)
        lift = torch.relu(wanted - speed) / self.inertia.response(touch.arms, touch.normals)
        return motion.pushed(self.inertia.push(touch.arms, lift * touch.is_active * touch.normals))

    def _facing(self, contacts: BodyContacts) -> _Facing:
        """Gather the points that may touch another body, packed to the largest count of the batch (at least one)."""
        count = max(1, int(contacts.known.sum(dim=1).max()))
        index = contacts.known.to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, :count]
        known, there = torch.gather(contacts.known, 1, index), torch.gather(contacts.other, 1, index)
        own, other = torch.gather(self.own, 1, index), torch.gather(self.own, 1, there)
        bodies = torch.arange(self.points.members.shape[1], device=own.device)
        from_first = own[:, None, None] == bodies[:, None, None]
        to_second = other[:, None, None] == bodies[:, None]
        offsets, other_offsets = vectors_of(self.offsets, index), vectors_of(self.offsets, there)
        normals = vectors_of(self.points.normals, there)
        return _Facing(own, offsets, other, other_offsets, normals, known[:, None, None] & from_first & to_second)

    def _pairs(
        self, motion: BodyMotion, free: BodyMotion, near: _Facing
    ) -> tuple[Pairs, Float[Tensor, "batch pair 1"]]:
        """Return the deepest contact of each pair of bodies after a motion, and how deep it is (metres)."""
        middles = motion.centers + motion.displacements
        here = vectors_of(middles, near.own) + motion.turned(near.offsets, near.own)
        there = vectors_of(middles, near.other) + motion.turned(near.other_offsets, near.other)
        facing = rotate(matrices_of(rotation_from_spin(motion.spins), near.other), near.other_normals)
        gaps = ((here - there) * facing).sum(dim=-1)
        count, usable = self.points.members.shape[1], near.usable
        bodies = torch.arange(count, device=gaps.device)
        deepest, probe = gaps[:, None, None].expand(usable.shape).masked_fill(~usable, torch.inf).min(dim=-1)
        depth, probe = torch.relu(-deepest).flatten(1)[..., None], probe.flatten(1)
        first, second = (
            index.expand(len(gaps), -1) for index in (bodies.repeat_interleave(count), bodies.repeat(count))
        )
        # Both bodies are pushed at one place, between the two points: at two, they would be turned out of nothing.
        place = (vectors_of(here, probe) + vectors_of(there, probe)) / 2
        normals = vectors_of(facing, probe)
        if self.num_driven:
            between = (here + there) / 2
            place, normals = self._spread(place, normals, between, facing, torch.where(usable, -gaps[:, None, None], 0))
        pairs = Pairs(
            first=first,
            second=second,
            first_arms=place - vectors_of(middles, first),
            second_arms=place - vectors_of(middles, second),
            normals=normals,
            approach=torch.zeros_like(depth),
            is_active=depth > 0,
        )
        return replace(pairs, approach=-(pairs.relative(free) * pairs.normals).sum(dim=-1, keepdim=True)), depth

    def _part(self, motion: BodyMotion, free: BodyMotion, near: _Facing) -> tuple[BodyMotion, Pairs]:
        """Push apart each pair of bodies at its deepest contact, half as far as needed from either side."""
        pairs, depth = self._pairs(motion, free, near)
        impulse = 0.5 * depth / self._pair_response(pairs, pairs.normals)
        sliding = pairs.relative(motion)
        sliding = sliding - (sliding * pairs.normals).sum(dim=-1, keepdim=True) * pairs.normals
        speed = sliding.square().sum(dim=-1, keepdim=True).clamp(min=1e-12).sqrt()
        direction = sliding / speed
        friction = self._pair_mean(self.materials.friction, pairs)
        drag = torch.minimum(0.5 * speed / self._pair_response(pairs, direction), friction * impulse)
        return self._pair_pushed(motion, pairs, impulse * pairs.normals - drag * direction), pairs

    def _spread(
        self,
        place: Tensor,
        normals: Tensor,
        middles: Tensor,
        facing: Tensor,
        depths: Float[Tensor, "batch body body any"],
    ) -> tuple[Tensor, Tensor]:
        """Return place and normal of each pair's contact; with a driven part, means over all probes that penetrate."""
        count = depths.shape[1]
        weights = torch.relu(depths).flatten(1, 2)
        weights = (weights / weights.amax(dim=-1, keepdim=True).clamp(min=1e-12)).square()
        total = weights.sum(dim=-1, keepdim=True)
        weights = weights / total.clamp(min=1e-12)
        is_driven = torch.arange(count, device=depths.device) >= count - self.num_driven
        chosen = ((is_driven[:, None] | is_driven).flatten()[:, None]) & (total > 0)
        mean = weights @ facing
        length = mean.square().sum(dim=-1, keepdim=True).clamp(min=1e-12).sqrt()
        return torch.where(chosen, weights @ middles, place), torch.where(chosen, mean / length, normals)

    def _bounce_apart(self, motion: BodyMotion, pairs: Pairs) -> BodyMotion:
        """Give back a share of the approach of two bodies, or at least take all of it away."""
        speed = (pairs.relative(motion) * pairs.normals).sum(dim=-1, keepdim=True)
        wanted = self._pair_mean(self.materials.restitution, pairs) * torch.relu(pairs.approach - self.rest_speed)
        impulse = 0.5 * torch.relu(wanted - speed) / self._pair_response(pairs, pairs.normals)
        return self._pair_pushed(motion, pairs, impulse * pairs.is_active * pairs.normals)

    @staticmethod
    def _pair_mean(values: Tensor, pairs: Pairs) -> Tensor:
        """Return the geometric mean of what two bodies are made of."""
        return (vectors_of(values, pairs.first) * vectors_of(values, pairs.second)).clamp(min=1e-12).sqrt()

    def _pair_response(self, pairs: Pairs, directions: Tensor) -> Tensor:
        """Return how far two bodies part, each at its contact, for a unit impulse."""
        each = [
            self.inertia.gathered(index).response(arm, directions) / vectors_of(self.masses, index)
            for index, arm in pairs.sides()
        ]
        return (each[0] + each[1]).clamp(min=1e-12)  # of two driven parts it is zero

    def _pair_pushed(self, motion: BodyMotion, pairs: Pairs, impulses: Tensor) -> BodyMotion:
        for sign, (index, arm) in zip((1, -1), pairs.sides(), strict=True):
            push = self.inertia.gathered(index).push(arm, sign * impulses / vectors_of(self.masses, index))
            motion = motion.pushed(_summed(push, index, self.points.members.shape[1]))
        return motion


def as_push(motion: BodyMotion) -> Push:
    """Return the velocities of a motion."""
    return Push(motion.displacements, motion.spins, motion.strains)


def velocity_at(push: Push, arms: Tensor) -> Tensor:
    """Return the velocity (metres per step) of the point at an arm."""
    return push.displacements + cross(push.spins, arms) + rotate(push.strains, arms)


def _gathered(push: Push, index: Tensor) -> Push:
    return Push(vectors_of(push.displacements, index), vectors_of(push.spins, index), matrices_of(push.strains, index))


def _summed(push: Push, index: Tensor, count: int) -> Push:
    """Add up pushes (``batch contact``) by the body they act on."""

    def add(values: Tensor) -> Tensor:
        flat = index.reshape(*index.shape, *[1] * (values.dim() - 2)).expand_as(values)
        return values.new_zeros(len(values), count, *values.shape[2:]).scatter_add(1, flat, values)

    return Push(add(push.displacements), add(push.spins), add(push.strains))
