"""Contact in parts of a step: what slides stands on its foot, because weight pulls between one push and the next."""

from dataclasses import replace

import torch
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion
from vpd_lightning.dynamics.inertial.contact import ContactSolver, Pairs, Resolved, as_push, velocity_at
from vpd_lightning.dynamics.inertial.contact_search import BodyContacts, Contacts


class SubstepSolver(ContactSolver):
    """Moves bodies in ``num_substeps`` equal parts of a step (as small steps in Macklin et al. 2019).

    In each part the velocity takes its share of the forces, then impulses at the contacts: no approach is left but what
    bounces, and friction is at most its coefficient times the impulse (Coulomb). What still penetrates is moved out
    without a change of velocity. A whole step at once applies the friction of its whole weight at one point, and tips
    what slides: no later push takes it back.
    """

    def resolve_in_parts(
        self,
        before: BodyMotion,
        free: BodyMotion,
        static: Contacts,
        between: BodyContacts | None,
        *,
        num_substeps: int,
        max_depth: float,
    ) -> Resolved:
        """Return the step; ``before`` is the velocity with which bodies came, ``free`` that after all forces."""
        touchable = self._touchable(static, max_depth)
        share = 1.0 / num_substeps
        facing = None if between is None else self._facing(between)
        done = _scaled(free, 0.0)
        forces = as_push(_scaled(free.pushed(as_push(_scaled(before, -1.0))), share))
        velocity, touching = before, torch.zeros_like(self.masses, dtype=torch.bool)
        for _ in range(num_substeps):
            velocity = velocity.pushed(forces)
            if facing is not None:
                trial = _moved(done, velocity, share)
                pairs, depth = self._pairs(trial, velocity, facing)
                changed = self._hit_apart(velocity, pairs)
                closing = (pairs.relative(changed) - pairs.relative(velocity)) * pairs.normals
                left = torch.relu(depth - share * closing.sum(dim=-1, keepdim=True))
                push = 0.5 * left / self._pair_response(pairs, pairs.normals) * pairs.is_active
                done = self._pair_pushed(done, pairs, push * pairs.normals)
                velocity, touching = changed, touching | pairs.touching
            trial = _moved(done, velocity, share)
            deepest, normal, arm, _ = self._deepest(trial, static, touchable)
            is_active = (deepest < 0) & torch.isfinite(deepest)
            changed = self._hit(velocity, arm, normal, is_active)
            closing = ((velocity_at(as_push(changed), arm) - velocity_at(as_push(velocity), arm)) * normal).sum(-1)
            left = torch.relu(-deepest - share * closing[..., None])
            lift = torch.where(is_active, left, 0.0) / self.inertia.response(arm, normal)
            done = done.pushed(self.inertia.push(arm, lift * normal))
            velocity, touching = changed, touching | is_active
            done = _moved(done, velocity, share)
        return Resolved(done, velocity, touching)

    def _hit(self, velocity: BodyMotion, arm: Tensor, normal: Tensor, is_active: Tensor) -> BodyMotion:
        """Take the approach to what stands still, give back what bounces, and slow the sliding."""
        speed = (velocity_at(as_push(velocity), arm) * normal).sum(dim=-1, keepdim=True)
        wanted = self.materials.restitution * torch.relu(-speed - self.rest_speed)
        lift = torch.relu(wanted - speed) * is_active / self.inertia.response(arm, normal)
        velocity = velocity.pushed(self.inertia.push(arm, lift * normal))
        move = velocity_at(as_push(velocity), arm)
        sliding = move - (move * normal).sum(dim=-1, keepdim=True) * normal
        size = sliding.square().sum(dim=-1, keepdim=True).clamp(min=1e-12).sqrt()
        direction = sliding / size
        stop = size / self.inertia.response(arm, direction)
        drag = -torch.minimum(stop, self.materials.friction * lift) * direction
        return velocity.pushed(self.inertia.push(arm, drag))

    def _hit_apart(self, velocity: BodyMotion, pairs: Pairs) -> BodyMotion:
        """The same between bodies, half of it from either side of a pair."""
        relative = pairs.relative(velocity)
        normals = pairs.normals
        speed = (relative * normals).sum(dim=-1, keepdim=True)
        wanted = self._pair_mean(self.materials.restitution, pairs) * torch.relu(-speed - self.rest_speed)
        response = self._pair_response(pairs, normals)
        impulse = 0.5 * torch.relu(wanted - speed) * pairs.is_active / response
        sliding = relative - speed * normals
        size = sliding.square().sum(dim=-1, keepdim=True).clamp(min=1e-12).sqrt()
        direction = sliding / size
        friction = self._pair_mean(self.materials.friction, pairs)
        stop = 0.5 * size / self._pair_response(pairs, direction)
        drag = torch.minimum(stop, friction * impulse)
        return self._pair_pushed(velocity, pairs, impulse * normals - drag * direction)


def _scaled(motion: BodyMotion, share: float) -> BodyMotion:
    return replace(
        motion,
        displacements=share * motion.displacements,
        spins=share * motion.spins,
        strains=share * motion.strains,
    )


def _moved(done: BodyMotion, velocity: BodyMotion, share: float) -> BodyMotion:
    """Return the motion so far after one more part at a velocity."""
    return done.pushed(as_push(_scaled(velocity, share)))
