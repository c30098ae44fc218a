"""Inertial dynamics: what moves keeps moving, as rigid or soft bodies; networks learn forces and materials."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.inertial.body_forces import BodyForces
from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, body_inertia, body_volumes, matrices_of, vectors_of
from vpd_lightning.dynamics.inertial.contact import Resolved
from vpd_lightning.dynamics.inertial.contact_points import contact_points
from vpd_lightning.dynamics.inertial.contact_step import BeforeContact, resolved_contacts, touched_by_driven
from vpd_lightning.dynamics.inertial.driven_bodies import DrivenBodies, driven_bodies
from vpd_lightning.dynamics.inertial.first_motion import (
    arriving_motion,
    find_first_motion,
    gather_index,
    movable,
    observed,
    put,
    relative_to,
    take,
)
from vpd_lightning.dynamics.inertial.first_velocity import FirstVelocity
from vpd_lightning.dynamics.inertial.hidden_side import HiddenGuess, hidden_after
from vpd_lightning.dynamics.inertial.materials import GuidanceNetwork, MaterialNetwork, elastic
from vpd_lightning.dynamics.inertial.memory import InertialMemory
from vpd_lightning.dynamics.inertial.resting import held, is_slow, members_in_use, rested
from vpd_lightning.dynamics.inertial.rigid_motion import equidistant_centers, rotate, rotation_from_spin
from vpd_lightning.dynamics.inertial.round_bodies import fit_ellipsoids, on_feet, with_feet
from vpd_lightning.dynamics.inertial.shading import MovingShading, StaticShading
from vpd_lightning.dynamics.inertial.skipping import step_where_it_moves
from vpd_lightning.dynamics.inertial.standing import may_be_hidden, standing
from vpd_lightning.dynamics.inertial.static_surface import static_contacts, static_surface, trusted_normals
from vpd_lightning.geometry.spacing import point_spacing
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Driven, Particles

_ARM = 0.2
"""Of the contact range, about a body's size: a rotation counts by how far it moves a point there."""

_BOUNCE_SHARE = 0.3
"""Impacts slower than this share of ``force_scale`` (metres per step) do not bounce, so that bodies come to rest."""


class InertialDynamics(AbstractDynamics):
    """Newton's first law built in, the second learned.

    What may move is divided into bodies (``graph.bodies``); ``first_velocity`` estimates how each moved between the two
    frames. Each step starts from the carried velocity, adds the forces (``BodyForces``) and the elastic return of soft
    bodies, resolves contact with static surfaces and between bodies (``ContactSolver``), and moves the particles. The
    friction, restitution, density and stiffness of a body are inferred from its features (``MaterialNetwork``). A body
    in contact that hardly moves stops (``rest_share`` of ``force_scale``). Particles that are not candidates for motion
    keep their place exactly. Features change only by shading: a turned surface, and with ``shadow_scales`` a moved
    shadow (without, shadows are left to a renderer that draws scenery).

    Neither gravity nor a floor is built in: at initialisation this is free motion, changed by contact and by 0.7 % of
    damping a step alone.

    With ``guess_hidden`` (and ``keep_shape`` and ``carry_memory``) the renderer gets what no camera saw of a body, too:
    mirror images through its centre (``Particles.hidden_side``).

    With ``has_driven``, driven points are rigid parts of infinite mass that push bodies, with a friction of their own
    that is learned (``driven_bodies``); nothing pushes them.

    With ``infers_guided`` features tell, too, what an unseen hand moves (``GuidanceNetwork``).
    With ``edge_reach`` (spacings of the static particles) a static surface ends that far beside its last particle, at a
    seen edge (``surface_edges``) with it, and goes on under bodies; null: it goes on without end, as it does beyond the
    sides of the workspace that cut it. A body that approaches the surface under it by less than ``supported_speed``
    (in ``force_scale``, per step) when it is first seen stands on it, whatever of its foot was seen
    (``static_surface``), and one that stands still does until something pushes it (``resting.held``).

    With ``num_contact_substeps`` contact is resolved in so many parts of a step (``SubstepSolver``); null: at once.

    With ``round_contact`` bodies that are ellipsoids, as far as was seen, roll as such (``round_bodies``).

    With ``skip_resting``, and without gradients, a member of the batch in which all bodies rest (in contact, slower
    than ``rest_share``) and nothing driven is about to push one stays as it is. Members that were one (candidate
    motions from one moment) are advanced once until something driven touches a body (``skipping``).

    For comparisons, each part can be left out: with ``first_velocity`` null bodies start at rest; with ``keep_shape``
    false every particle goes on with its own velocity, to which it adds what its body's changes by; with
    ``carry_memory`` false velocities and bodies are found anew from every two predicted frames; with ``rest_share``
    zero nothing stops.
    """

    # Paper: the dynamics is a hierarchical GNN without velocities or correspondences; this one is ours
    # (docs/architecture.md). It uses no privileged information.

    def __init__(
        self,
        *,
        feature_dim: int,
        hidden_dim: int,
        num_bodies: int,
        body_link: float,
        max_concavity: float,
        max_concave_share: float,
        first_velocity: FirstVelocity | None,
        num_probes: int,
        message_passing_steps: int,
        num_forces: int,
        location_scale: float,
        force_scale: float,
        residual_share: float,
        acceleration_gain: float,
        contact_range: float,
        force_reach: float | None,
        contact_reach: float,
        num_contact_iterations: int,
        num_contact_substeps: int | None,
        max_contact_depth: float,
        mirror_hidden: bool,
        is_soft: bool,
        max_friction: float | None,
        infers_guided: bool,
        rest_share: float,
        keep_shape: bool,
        carry_memory: bool,
        shadow_scales: Sequence[float] | None,
        extent_weight: float,
        guess_hidden: bool,
        has_driven: bool,
        edge_reach: float | None,
        workspace_min: Sequence[float] | None,
        workspace_max: Sequence[float] | None,
        supported_speed: float,
        round_contact: bool,
        is_damped: bool,
        skip_resting: bool,
    ):
        super().__init__()
        counts = {"num_bodies": num_bodies, "num_probes": num_probes, "num_contact_substeps": num_contact_substeps or 1}
        for name, count in counts.items():
            if count < 1:
                raise ValueError(f"{name} must be at least 1, got {count}")
        lengths = {"body_link": body_link, "location_scale": location_scale, "force_scale": force_scale}
        reaches = {"edge_reach": edge_reach, "force_reach": force_reach, "acceleration_gain": acceleration_gain}
        for name, value in {**lengths, **reaches}.items():
            if value is not None and value <= 0:
                raise ValueError(f"{name} must be positive, got {value}")
        shares = {"rest_share": rest_share, "residual_share": residual_share, "extent_weight": extent_weight}
        for name, value in {**shares, "supported_speed": supported_speed}.items():
            if value < 0:
                raise ValueError(f"{name} must not be negative, got {value}")
        self.num_probes, self.first_velocity = num_probes, first_velocity
        limits = {"max_concavity": max_concavity, "max_concave_share": max_concave_share}
        self.grouping = {"num_bodies": num_bodies, "body_link": body_link, **limits}
        self.force_scale, self.rest_share = force_scale, rest_share
        self.contact_range, self.contact_reach = contact_range, contact_reach
        self.num_contact_iterations, self.num_contact_substeps = num_contact_iterations, num_contact_substeps
        self.mirror_hidden, self.keep_shape, self.carry_memory = mirror_hidden, keep_shape, carry_memory
        self.max_contact_depth, self.extent_weight = max_contact_depth, extent_weight
        self.log_inertia_ratio = nn.Parameter(torch.zeros(()))
        self.forces = BodyForces(
            hidden_dim=hidden_dim,
            message_passing_steps=message_passing_steps,
            num_forces=num_forces,
            location_scale=location_scale,
            force_scale=force_scale,
            residual_share=residual_share,
            acceleration_gain=acceleration_gain,
            contact_range=contact_range,
            force_reach=force_reach,
            is_damped=is_damped,
        )
        sizes = {"feature_dim": feature_dim, "hidden_dim": hidden_dim}
        self.materials = MaterialNetwork(**sizes, is_soft=is_soft, max_friction=max_friction)
        self.moving_shading = MovingShading(**sizes)
        is_guessing = guess_hidden and keep_shape and carry_memory
        self.hidden_guess = HiddenGuess(feature_dim=feature_dim) if is_guessing else None
        self.edge_reach, self.supported_speed, self.skip_resting = edge_reach, supported_speed, skip_resting
        self.workspace = None if workspace_min is None or workspace_max is None else (workspace_min, workspace_max)
        self.round_contact, self.has_driven = round_contact, has_driven
        self.log_driven_friction = nn.Parameter(torch.tensor(math.log(0.3))) if has_driven else None
        self.static_shading = None if shadow_scales is None else StaticShading(**sizes, scales=shadow_scales)
        self.guidance = GuidanceNetwork(**sizes) if infers_guided else None

    def initialize(self, previous: Particles, current: Particles, keys: RandomKeys) -> InertialMemory:
        """Divide what may move into bodies, and estimate their first velocities."""
        previous, current = observed(previous, current)
        with torch.autocast(current.positions.device.type, enabled=False):  # geometry in full precision
            return self._first_memory(previous, current)

    def _first_memory(self, previous: Particles, current: Particles) -> InertialMemory:
        # As seen from a particle's place: far from the world's origin coordinates have few digits left.
        index, _ = gather_index(movable(current))
        origin = take(current.positions, index[:, :1]).detach()
        previous, current = (relative_to(frame, origin) for frame in (previous, current))
        found = find_first_motion(previous, current, first_velocity=self.first_velocity, **self.grouping)  # type: ignore[arg-type]
        index, mask, seen, bodies = found.index, found.mask, found.seen, found.bodies
        shares = bodies / bodies.sum(dim=-1, keepdim=True).clamp(min=1)
        with torch.no_grad():
            centers = equidistant_centers(seen.positions, seen.normals, shares, self.extent_weight)
            shapes = centers.new_zeros(*centers.shape, 3)
            if self.round_contact:
                centers, shapes = fit_ellipsoids(seen.positions, seen.normals, bodies, centers)
            static_index, static_mask = gather_index(current.mask & ~movable(current))
            static_positions = take(current.positions, static_index)
            static_normals = take(current.normals, static_index)  # type: ignore[arg-type]
            static_normals = trusted_normals(static_positions, static_normals, static_mask)
            mirrored = mask & may_be_hidden(
                (static_positions, static_normals, static_mask),
                seen.positions, bodies, centers, self.contact_reach,
            )  # fmt: skip
            spacing = point_spacing(seen.positions, mask)
        materials = self.materials(seen.features, shares)
        masses = materials.density * body_volumes(seen.positions, centers, shares)
        guided = None if self.guidance is None else self.guidance(seen.features, shares)
        hidden = None
        if self.hidden_guess is not None:
            hidden = self.hidden_guess(seen, bodies, found.own, centers, mirrored, self.moving_shading)
        static_features = take(current.features, static_index)
        empty = torch.zeros_like(bodies[..., 0])
        memory = InertialMemory(
            origin=origin,
            index=index,
            mask=mask,
            bodies=bodies,
            own=found.own,
            motion=arriving_motion(seen.positions, found.matched.displacements, shares, centers),
            materials=materials,
            masses=masses if guided is None else masses / (1 - guided).clamp(min=1e-3),
            guided=guided,
            spacing=spacing,
            normals=seen.normals,
            velocities=found.matched.displacements,
            mirrored=mirrored,
            first_features=seen.features,
            first_shade=self.moving_shading(seen.features, seen.normals),
            static_index=static_index,
            static_mask=static_mask,
            static_normals=static_normals,
            static_features=static_features,
            static_shade=(
                torch.zeros_like(static_features)
                if self.static_shading is None
                else self.static_shading(static_features, static_positions, seen.positions, mask)
            ),
            hidden=hidden,
            undisturbed=torch.zeros_like(empty, dtype=torch.bool),
            surface=static_surface((seen.positions, seen.normals, mask), seen.positions, mask, None, empty),
            shapes=shapes,
            at_rest=~members_in_use(bodies),
            past=torch.arange(len(mask), device=mask.device),
        )
        return standing(
            memory,
            seen.positions,
            (static_positions, static_normals, static_mask),
            current.driven if self.has_driven else None,
            num_probes=self.num_probes,
            is_mirrored=self.mirror_hidden,
            supported_speed=self.supported_speed * self.force_scale,
            rest_speed=self.rest_share * self.force_scale,
            arm=_ARM * self.contact_range,
            edge_reach=self.edge_reach,
            workspace=self.workspace,
            far=self.contact_reach,
        )

    def completed(self, previous: Particles, current: Particles, keys: RandomKeys) -> Particles:
        """Return the current particles with what is guessed of the hidden sides of bodies."""
        if self.hidden_guess is None or current.num_particles == 0:
            return current
        memory = self.initialize(previous, current, keys)
        assert memory.hidden is not None
        positions, centers = take(current.positions, memory.index) - memory.origin, memory.motion.centers
        places = positions, centers, rotation_from_spin(torch.zeros_like(centers))
        _, side = hidden_after(memory.hidden, *places, self.moving_shading, memory.origin)
        return replace(current, hidden_side=side)

    def forward(
        self, previous: Particles, current: Particles, memory: Any, keys: RandomKeys, rollout_step: int
    ) -> tuple[Particles, InertialMemory]:
        """Advance one step; see the class."""
        if current.num_particles == 0:
            return current, memory
        current = replace(current.without_padding(), pixels=None, pictures=None)  # those of what was observed
        with torch.autocast(current.positions.device.type, enabled=False):  # geometry in full precision
            if not self.carry_memory and rollout_step > 0:
                memory = self._first_memory(*observed(previous, current))
            if not self.skip_resting or torch.is_grad_enabled():
                return self._step(current, memory)
            return step_where_it_moves(
                self._step,
                self._touches,
                current,
                memory,
                take(current.positions, memory.index) - memory.origin,
                current.driven if self.has_driven else None,
                is_mirrored=self.mirror_hidden,
                has_all_sides=self.hidden_guess is None or current.hidden_side is not None,
            )

    def _step(self, current: Particles, memory: InertialMemory) -> tuple[Particles, InertialMemory]:
        positions = take(current.positions, memory.index) - memory.origin
        static_positions = take(current.positions, memory.static_index) - memory.origin
        driven = None
        if self.has_driven and current.driven is not None and current.driven.mask.any():
            driven = driven_bodies(current.driven, memory.origin)
        resolved = self._resolved(positions, static_positions, memory, driven)
        resting = self.rest_share * self.force_scale, _ARM * self.contact_range
        step, onward = rested(resolved, *resting, memory.guided)
        own = memory.own
        moved = step.carried(positions, own)
        velocities = memory.velocities
        if not self.keep_shape:
            velocities = velocities + moved - memory.motion.carried(positions, own)
            moved = positions + velocities
        following = torch.where(memory.mask[..., None], moved, positions)
        rotations = rotation_from_spin(step.spins)
        turned = rotate(matrices_of(rotations, own), memory.normals)
        all_positions = put(current.positions, memory.index, following + memory.origin, memory.mask)
        features = self._shade(current, memory, static_positions, following, turned)
        stretches, _ = step.following_stretches()
        _, strains = onward.following_stretches()
        onward = BodyMotion(step.centers + step.displacements, onward.displacements, onward.spins, stretches, strains)
        hidden, side = memory.hidden, None
        if hidden is not None:
            places = (following, onward.centers, rotations)
            hidden, side = hidden_after(hidden, *places, self.moving_shading, memory.origin)
        is_slow_now = is_slow(onward, *resting)
        undisturbed = memory.undisturbed & is_slow_now
        at_rest = resolved.touching.squeeze(-1) & is_slow_now | undisturbed | ~members_in_use(memory.bodies)
        shapes = rotations @ memory.shapes @ rotations.mT
        moving = {"motion": onward, "normals": turned, "velocities": velocities, "hidden": hidden, "shapes": shapes}
        memory = replace(memory, undisturbed=undisturbed, at_rest=at_rest, **moving)
        # Normals rotate with their bodies: a memory rebuilt from these particles needs those of the new pose.
        normals = put(current.normals, memory.index, turned, memory.mask)  # type: ignore[arg-type]
        return replace(current, positions=all_positions, features=features, normals=normals, hidden_side=side), memory

    def _touches(self, current: Particles, memory: InertialMemory, driven: Driven, place: Tensor) -> Tensor:
        """Return which of the driven motions touch a body in the state that ``place`` says."""
        positions = take(current.positions, memory.index) - memory.origin
        step = self._before_contact(positions, take(current.positions, memory.static_index) - memory.origin, memory)
        return touched_by_driven(driven, step, positions, memory, place, is_mirrored=self.mirror_hidden)

    def _before_contact(self, positions: Tensor, static_positions: Tensor, memory: InertialMemory) -> BeforeContact:
        """Return the step after forces and elastic return."""
        probes = slice(0, self.num_probes)
        probe_positions, members = positions[:, probes], memory.bodies[:, :, probes]
        materials = memory.materials
        shares = memory.bodies / memory.bodies.sum(dim=-1, keepdim=True).clamp(min=1)
        inertia = body_inertia(
            positions, memory.motion.centers, shares, materials.softness, self.log_inertia_ratio.exp()
        )
        own = memory.own[:, probes]
        offsets = probe_positions - vectors_of(memory.motion.centers, own)
        moved = vectors_of(memory.motion.displacements, own) + memory.motion.turned(offsets, own) - offsets
        statics = (static_positions, memory.static_normals, memory.static_mask)
        points = contact_points(probe_positions, memory, members, self.mirror_hidden)
        surface, centers, far = memory.surface, memory.motion.centers, self.contact_reach
        joined = surface.joined(statics)
        points = with_feet(points, memory.shapes, memory.motion, joined, surface.edges, surface.clearances, far)
        contacts = static_contacts(surface, points, statics, centers, far)
        motion = self.forces(
            moved * memory.mask[:, probes, None],
            memory.mask[:, probes],
            points,
            contacts,
            memory.motion,
            inertia,
        )
        motion = held(replace(motion, strains=elastic(motion, materials)), memory.undisturbed)
        return BeforeContact(motion, inertia, points, on_feet(contacts, points, far))

    def _resolved(
        self, positions: Tensor, static_positions: Tensor, memory: InertialMemory, driven: DrivenBodies | None
    ) -> Resolved:
        """Return the step after forces, elastic return and contact."""
        return resolved_contacts(
            self._before_contact(positions, static_positions, memory),
            memory,
            positions,
            driven,
            None if self.log_driven_friction is None else self.log_driven_friction.exp(),
            is_mirrored=self.mirror_hidden,
            rest_speed=_BOUNCE_SHARE * self.force_scale,
            num_iterations=self.num_contact_iterations,
            num_substeps=self.num_contact_substeps,
            max_depth=self.max_contact_depth,
        )

    def _shade(
        self, current: Particles, memory: InertialMemory, static_positions: Tensor, following: Tensor, turned: Tensor
    ) -> Tensor:
        """Features are the observed ones plus what turned and what moved since; nothing accumulates."""
        moving, static = memory.first_features, memory.static_features
        moving = moving + (self.moving_shading(moving, turned) - memory.first_shade)
        features = put(current.features, memory.index, moving, memory.mask)
        if self.static_shading is None:
            return features
        shade = self.static_shading(static, static_positions, following, memory.mask)
        return put(features, memory.static_index, static + (shade - memory.static_shade), memory.static_mask)
