"""Inertial dynamics: what moves keeps moving as a locally rigid body; a graph network predicts the corrections."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.body_forces import BodyForces
from vpd_lightning.dynamics.contact import nearest_static_contacts, resolve_contacts
from vpd_lightning.dynamics.rigid_motion import (
    Twists,
    anchor_weights,
    equidistant_centers,
    farthest_points,
    fit_twists,
    invert_inertia,
    match_locally_rigid,
    rotate,
    rotation_from_spin,
)
from vpd_lightning.dynamics.shading import MovingShading, StaticShading
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles, require_finite


@dataclass(frozen=True)
class InertialMemory:
    """What the inertial dynamics carries from step to step; gathered over the particles that may move."""

    index: Int[Tensor, "batch moving"]  # slots of the moving candidates among all particles
    mask: Bool[Tensor, "batch moving"]
    displacements: Float[Tensor, "batch moving 3"]  # of the last step, exact from the second prediction on
    fit_weights: Float[Tensor, "batch anchor moving"]  # rows sum to one: which particles an anchor is fitted to
    centers: Float[Tensor, "batch anchor 3"]  # of the body an anchor belongs to; carried along as if it were a particle
    center_displacements: Float[Tensor, "batch anchor 3"]
    body_weights: Float[Tensor, "batch anchor moving"]  # rows sum to one, wider than fit_weights: whose mass it is
    blend_weights: Float[Tensor, "batch anchor moving"]  # columns sum to one: which anchors carry a particle
    normals: Float[Tensor, "batch moving 3"]
    first_features: Float[Tensor, "batch moving feature"]
    first_normals: Float[Tensor, "batch moving 3"]
    static_index: Int[Tensor, "batch static"]
    static_mask: Bool[Tensor, "batch static"]
    static_features: Float[Tensor, "batch static feature"]
    static_surroundings: Float[Tensor, "batch static channel"]  # where the moving ones were at first


class InertialDynamics(AbstractDynamics):
    """Newton's first law built in, the second learned.

    The first velocity comes from locally rigid soft matching of the two frames; afterwards correspondences are exact.
    Each step fits the last displacement by one twist per anchor, lets ``BodyForces`` correct the twists, keeps them out
    of what stands still (``resolve_contacts``), and moves the particles by the blended twists. Particles that are not
    candidates for motion keep their place exactly. Features change only by shading: a turned surface, a moved shadow.
    At initialisation this is a screw motion that contact alone changes, but for 0.7 % of damping a step.
    """

    # Paper: the dynamics is a hierarchical GNN without velocities or correspondences; this one is ours
    # (docs/architecture.md). It uses no privileged information.

    def __init__(
        self,
        *,
        feature_dim: int,
        hidden_dim: int,
        num_anchors: int,
        anchor_radius: float,
        body_radius: float,
        num_probes: int,
        message_passing_steps: int,
        num_forces: int,
        location_scale: float,
        contact_range: float,
        contact_reach: float,
        num_contact_iterations: int,
        max_contact_depth: float,
        match_scales: Sequence[float],
        match_color_scale: float,
        match_radius: float,
        num_matched: int,
        shadow_scales: Sequence[float],
    ):
        super().__init__()
        for name, value in (("num_anchors", num_anchors), ("num_probes", num_probes), ("num_matched", num_matched)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        for name, scale in (("anchor_radius", anchor_radius), ("location_scale", location_scale)):
            if scale <= 0:
                raise ValueError(f"{name} must be positive, got {scale}")
        self.num_anchors, self.num_probes, self.num_matched = num_anchors, num_probes, num_matched
        self.anchor_radius, self.body_radius, self.match_radius = anchor_radius, body_radius, match_radius
        self.match_scales, self.match_color_scale = list(match_scales), match_color_scale
        self.contact_range, self.contact_reach = contact_range, contact_reach
        self.num_contact_iterations, self.max_contact_depth = num_contact_iterations, max_contact_depth
        self.log_inertia_ratio = nn.Parameter(torch.zeros(()))
        self.log_friction = nn.Parameter(torch.tensor(0.5).log())
        self.forces = BodyForces(
            hidden_dim=hidden_dim,
            message_passing_steps=message_passing_steps,
            num_forces=num_forces,
            scale=location_scale,
            contact_range=contact_range,
        )
        self.moving_shading = MovingShading(feature_dim=feature_dim, hidden_dim=hidden_dim)
        self.static_shading = StaticShading(feature_dim=feature_dim, hidden_dim=hidden_dim, scales=shadow_scales)

    @staticmethod
    def _movable(particles: Particles) -> Tensor:
        return particles.mask if particles.moving is None else particles.mask & particles.moving

    def initialize(self, previous: Particles, current: Particles, keys: RandomKeys) -> InertialMemory:
        """Estimate the first velocities and attach the moving candidates to anchors."""
        if previous.colors is None or current.colors is None or current.normals is None:
            raise ValueError("the inertial dynamics needs observed colors and normals; set encoder.use_normals=true")
        previous, current = previous.without_padding(), current.without_padding()
        require_finite(
            "Dynamics",
            positions=torch.cat([previous.positions, current.positions], dim=1),
            features=current.features,
            colors=torch.cat([previous.colors, current.colors], dim=1),
            normals=current.normals,
        )
        with torch.autocast(current.positions.device.type, enabled=False):  # geometry in full precision
            return self._first_memory(previous, current)

    def _first_memory(self, previous: Particles, current: Particles) -> InertialMemory:
        previous, current = _with_a_slot(previous), _with_a_slot(current)
        movable = self._movable(current)
        index, mask = _gather_index(movable)
        positions = _take(current.positions, index)
        with torch.no_grad():
            displacements = self._first_displacements(previous, positions, _take(current.colors, index), mask)
            anchors = farthest_points(positions, mask, self.num_anchors)
            affinity = anchor_weights(anchors, positions, mask, self.anchor_radius)
            wide = anchor_weights(anchors, positions, mask, self.body_radius)
            normals = _take(current.normals, index)
            body_weights, fit_weights = _normalize(wide, dim=-1), _normalize(affinity, dim=-1)
            centers = equidistant_centers(positions, normals, body_weights)
            twists = fit_twists(positions, displacements, fit_weights)
            center_displacements = centers - _apply_each(centers, _reverse(twists))
            static_index, static_mask = _gather_index(current.mask & ~movable)
            surroundings = self.static_shading.surroundings(_take(current.positions, static_index), positions, mask)
        return InertialMemory(
            index=index,
            mask=mask,
            displacements=displacements,
            fit_weights=fit_weights,
            centers=centers,
            center_displacements=center_displacements,
            body_weights=body_weights,
            blend_weights=_normalize(affinity, dim=1),
            normals=normals,
            first_features=_take(current.features, index),
            first_normals=normals,
            static_index=static_index,
            static_mask=static_mask,
            static_features=_take(current.features, static_index),
            static_surroundings=surroundings,
        )

    def _first_displacements(self, previous: Particles, positions: Tensor, colors: Tensor, mask: Tensor) -> Tensor:
        """Match (some of) the moving candidates to those of the previous frame and spread the rigid motion to all."""
        target_index, target_mask = _gather_index(self._movable(previous))
        some, target_some = slice(0, self.num_matched), slice(0, 2 * self.num_matched)  # slots are in random order
        matched = match_locally_rigid(
            positions[:, some],
            colors[:, some],
            mask[:, some],
            _take(previous.positions, target_index[:, target_some]),
            _take(previous.colors, target_index[:, target_some]),  # type: ignore[arg-type]
            target_mask[:, target_some],
            num_anchors=self.num_anchors,
            radius=self.match_radius,
            match_scales=self.match_scales,
            color_scale=self.match_color_scale,
        )
        anchors = farthest_points(positions[:, some], mask[:, some], self.num_anchors)
        affinity = anchor_weights(anchors, positions, mask, self.match_radius)
        displacements = positions[:, some] - matched
        twists = fit_twists(positions[:, some], displacements, _normalize(affinity[:, :, some], dim=-1))
        carried = positions - _apply_twists(positions, _reverse(twists), _normalize(affinity, dim=1))
        both_seen = mask.any(dim=1) & target_mask.any(dim=1)
        return carried * (mask & both_seen[:, None])[..., None]

    def forward(
        self, previous: Particles, current: Particles, memory: Any, keys: RandomKeys, rollout_step: int
    ) -> tuple[Particles, InertialMemory]:
        """Advance one step; see the class."""
        if current.num_particles == 0:
            return current, memory
        current = current.without_padding()
        device_type = current.positions.device.type
        with torch.autocast(device_type, enabled=False):  # geometry in full precision
            return self._step(current, memory)

    def _step(self, current: Particles, memory: InertialMemory) -> tuple[Particles, InertialMemory]:
        positions = _take(current.positions, memory.index)
        twists = self._carried_twists(positions, memory)
        probes = slice(0, self.num_probes)
        static_positions = _take(current.positions, memory.static_index)
        contacts = nearest_static_contacts(
            positions[:, probes],
            static_positions,
            _take(current.normals, memory.static_index),  # type: ignore[arg-type]
            memory.static_mask,
            self.contact_reach,
        )
        # Mass inside a body is not where its surface particles are: one learned factor on their inverse inertia.
        inverse_inertia = invert_inertia(positions, memory.centers, memory.body_weights) * self.log_inertia_ratio.exp()
        weights = memory.fit_weights[:, :, probes]
        twists = self.forces(
            positions[:, probes],
            memory.displacements[:, probes],
            contacts,
            memory.mask[:, probes],
            weights,
            twists,
            inverse_inertia,
        )
        twists = resolve_contacts(
            twists,
            positions[:, probes],
            contacts,
            memory.mask[:, None, probes] & (weights > 1e-3 * weights.amax(dim=-1, keepdim=True)),
            inverse_inertia,
            self.log_friction.exp(),
            num_iterations=self.num_contact_iterations,
            max_depth=self.max_contact_depth,
        )
        following = _apply_twists(positions, twists, memory.blend_weights)
        following = torch.where(memory.mask[..., None], following, positions)
        rotations = rotation_from_spin(torch.einsum("bap,bac->bpc", memory.blend_weights, twists.spins))
        turned = rotate(rotations, memory.normals)
        all_positions = _put(current.positions, memory.index, following, memory.mask)
        features = self._shade(current, memory, static_positions, following, turned)
        memory = replace(
            memory,
            displacements=following - positions,
            normals=turned,
            centers=twists.centers + twists.displacements,
            center_displacements=twists.displacements,
        )
        return replace(current, positions=all_positions, features=features), memory

    @staticmethod
    def _carried_twists(positions: Tensor, memory: InertialMemory) -> Twists:
        """Continue the last displacement in free motion: the body's centre moves straight, the spin stays."""
        fitted = fit_twists(positions, memory.displacements, memory.fit_weights)
        return Twists(memory.centers, memory.center_displacements, fitted.spins)

    def _shade(
        self, current: Particles, memory: InertialMemory, static_positions: Tensor, following: Tensor, turned: Tensor
    ) -> Tensor:
        """Features are the observed ones plus what turned and what moved since; nothing accumulates."""
        moving = memory.first_features
        moving = moving + self.moving_shading(moving, memory.first_normals, turned)
        surroundings = self.static_shading.surroundings(static_positions, following, memory.mask)
        static = memory.static_features
        static = static + self.static_shading(static, memory.static_surroundings, surroundings)
        features = _put(current.features, memory.index, moving, memory.mask)
        return _put(features, memory.static_index, static, memory.static_mask)


def _with_a_slot(particles: Particles) -> Particles:
    """Return the particles with one slot of padding where they have no slots at all."""
    if particles.num_particles > 0:
        return particles
    slots = {item.name: getattr(particles, item.name) for item in fields(particles)}
    shapes = {name: (len(value), 1, *value.shape[2:]) for name, value in slots.items() if value is not None}
    return Particles(**{name: slots[name].new_zeros(shape) for name, shape in shapes.items()})


def _gather_index(chosen: Bool[Tensor, "batch particle"]) -> tuple[Tensor, Tensor]:
    """Return slots of the chosen particles, packed to the largest count of the batch (at least one), and a mask."""
    count = max(1, int(chosen.sum(dim=1).max()))
    index = torch.sort((~chosen).to(torch.uint8), dim=1, stable=True).indices[:, :count]
    return index, torch.gather(chosen, 1, index)


def _take(values: Tensor, index: Tensor) -> Tensor:
    return torch.gather(values, 1, index[..., None].expand(-1, -1, values.shape[-1]))


def _put(values: Tensor, index: Tensor, new: Tensor, mask: Tensor) -> Tensor:
    """Return ``values`` with ``new`` at the valid slots; the others keep what they had, bit for bit."""
    new = torch.where(mask[..., None], new, _take(values, index))
    return values.scatter(1, index[..., None].expand_as(new), new)


def _normalize(weights: Tensor, dim: int) -> Tensor:
    return weights / weights.sum(dim=dim, keepdim=True).clamp(min=1e-12)


def _reverse(twists: Twists) -> Twists:
    """Return the motion back: fitted centres are those after the step."""
    return replace(twists, displacements=-twists.displacements, spins=-twists.spins)


def _apply_each(points: Float[Tensor, "batch anchor 3"], twists: Twists) -> Float[Tensor, "batch anchor 3"]:
    """Move one point with each anchor."""
    turned = rotate(rotation_from_spin(twists.spins), points - twists.centers)
    return twists.centers + twists.displacements + turned


def _apply_twists(
    positions: Float[Tensor, "batch particle 3"], twists: Twists, blend: Float[Tensor, "batch anchor particle"]
) -> Float[Tensor, "batch particle 3"]:
    rotations = rotation_from_spin(twists.spins)
    offsets = positions[:, None] - twists.centers[:, :, None]
    moved = (twists.centers + twists.displacements)[:, :, None] + rotate(rotations[:, :, None], offsets)
    return (blend[..., None] * moved).sum(dim=1)
