"""The paper's graph network, told how fast its particles are: what a velocity alone is worth."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.hierarchical_gnn import HierarchicalGNNDynamics
from vpd_lightning.dynamics.inertial.first_motion import (
    FirstMotion,
    find_first_motion,
    gather_index,
    movable,
    observed,
    put,
    take,
)
from vpd_lightning.dynamics.inertial.first_velocity import FirstVelocity
from vpd_lightning.graph.neighbors import knn
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles

_NUM_INPUTS = 5
"""What a node is told beside its features: velocity (3), confidence, and whether it may move."""


@dataclass(frozen=True)
class VelocityMemory:
    """How far each particle goes from the previous frame to the current one (metres), and how far that is believed.

    Both are zero for what may not move; belief goes to 1. It is that in the first velocity, on which all later ones
    build.
    """

    previous_velocities: Float[Tensor, "batch previous 3"]
    previous_confidence: Float[Tensor, "batch previous"]
    velocities: Float[Tensor, "batch particle 3"]
    confidence: Float[Tensor, "batch particle"]


class VelocityGNNDynamics(AbstractDynamics):
    """Algorithm 1 of the paper (``HierarchicalGNNDynamics``) with the velocity of each particle beside its features.

    It stands between the paper's network, which must find motion in two clouds without correspondences, and
    ``InertialDynamics``, which also builds in bodies and contact: so that it is known what each ingredient buys. Bodies
    and their first velocity are found as there (``find_first_motion``). From the first predicted step on
    correspondences are exact, and a particle's velocity is its last displacement, without the location noise of a
    training. With ``first_velocity`` null everything starts at rest.

    Each node of both frames is told five numbers more: velocity / location_scale, confidence, and whether it may move.
    A particle of the first previous frame takes the velocity of the nearest particle of the current one, seen where
    that was then. With ``adds_velocity`` a particle goes on by its velocity + location_scale * tanh(decoded), and the
    decoder starts at zero: straight motion. Without it, it goes on by location_scale * tanh(decoded) as in the paper,
    and its velocity is an input only.

    The graph network is built for features that are five numbers wider and what it adds to those five is dropped, so
    that all it offers (fixed shapes, compilation) works here, too. That leaves 5 * (hidden_dim + 1) weights without
    effect. The other arguments are those of ``HierarchicalGNNDynamics`` and ``graph.bodies.label_bodies``.
    """

    # Paper: the paper's network knows no velocity; it sees the particles of two frames.

    def __init__(
        self,
        *,
        adds_velocity: bool,
        num_bodies: int,
        body_link: float,
        max_concavity: float,
        max_concave_share: float,
        first_velocity: FirstVelocity | None,
        feature_dim: int,
        hidden_dim: int,
        message_passing_steps: int,
        num_abstract_nodes: int,
        max_abstract_neighbors: int,
        r_s: float,
        r_a_s: float,
        location_scale: float,
        feature_limit: float,
        neighbors_backend: str,
        edge_capacity: int | None,
        max_abstract_edges_per_node: int | None,
        compile: bool,
    ) -> None:
        super().__init__()
        if feature_dim < 1:
            raise ValueError(f"feature_dim must be at least 1, got {feature_dim}.")
        if num_bodies < 1:
            raise ValueError(f"num_bodies must be at least 1, got {num_bodies}.")
        if not body_link > 0:
            raise ValueError(f"body_link must be greater than 0, got {body_link}.")
        self.adds_velocity, self.feature_dim = adds_velocity, feature_dim
        self.num_bodies, self.body_link = num_bodies, body_link
        self.max_concavity, self.max_concave_share = max_concavity, max_concave_share
        self.first_velocity = first_velocity
        self.network = HierarchicalGNNDynamics(
            feature_dim=feature_dim + _NUM_INPUTS,
            hidden_dim=hidden_dim,
            message_passing_steps=message_passing_steps,
            num_abstract_nodes=num_abstract_nodes,
            max_abstract_neighbors=max_abstract_neighbors,
            r_s=r_s,
            r_a_s=r_a_s,
            location_scale=location_scale,
            feature_limit=feature_limit,
            neighbors_backend=neighbors_backend,
            edge_capacity=edge_capacity,
            max_abstract_edges_per_node=max_abstract_edges_per_node,
            compile=compile,
        )
        if adds_velocity:
            last = self.network.decode_location.layers[-1]
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    @property
    def last_uncovered_share(self) -> Tensor | None:
        """That of the graph network."""
        return self.network.last_uncovered_share

    def check_faults(self) -> None:
        """Wait for the device, and raise what the graph network met in its last static step; see there."""
        self.network.check_faults()

    def initialize(self, previous: Particles, current: Particles, keys: RandomKeys) -> VelocityMemory:
        """Divide what may move into bodies, and find their first velocities.

        Raises:
            ValueError: colours or normals were not observed.
            NonFiniteError: a valid particle is not finite.
        """
        before, now = observed(previous, current)
        with torch.autocast(now.positions.device.type, enabled=False):  # geometry in full precision
            found = find_first_motion(
                before,
                now,
                num_bodies=self.num_bodies,
                body_link=self.body_link,
                max_concavity=self.max_concavity,
                max_concave_share=self.max_concave_share,
                first_velocity=self.first_velocity,
            )
            motion = torch.cat([found.matched.displacements, found.matched.confidence[..., None]], dim=-1)
            index, mask = gather_index(movable(before))
            passed_on = self._passed_on(motion, found, take(before.positions, index))
            first = put(before.positions.new_zeros(*before.mask.shape, 4), index, passed_on, mask)
            second = put(now.positions.new_zeros(*now.mask.shape, 4), found.index, motion, found.mask)
        first, second = first[:, : previous.num_particles], second[:, : current.num_particles]
        return VelocityMemory(first[..., :3], first[..., 3], second[..., :3], second[..., 3])

    def _passed_on(
        self, motion: Float[Tensor, "batch moving 4"], found: FirstMotion, places: Float[Tensor, "batch before 3"]
    ) -> Float[Tensor, "batch before 4"]:
        """Return the motion of what is nearest to each place of the previous frame, moved back to then."""
        was = found.seen.positions - found.matched.displacements
        rows = []
        for own_motion, own_was, own_mask, own_places in zip(motion, was, found.mask, places, strict=True):
            points, values = own_was[own_mask], own_motion[own_mask]
            nearest = knn(points, own_places, 1, backend=self.network.neighbors_backend)
            values = torch.cat([values, values.new_zeros(1, 4)])  # of nothing, where there is nothing to be near to
            rows.append(values[torch.where(nearest.mask, nearest.index, len(points))[:, 0]])
        return torch.stack(rows)

    def forward(
        self, previous: Particles, current: Particles, memory: VelocityMemory, keys: RandomKeys, rollout_step: int
    ) -> tuple[Particles, VelocityMemory]:
        """Return the particles of the next step, and their velocities.

        Raises:
            NonFiniteError: when a valid particle is not finite.
            ConfigError: when edges did not fit into ``edge_capacity`` in an earlier call.
        """
        told = (
            self._told(previous, memory.previous_velocities, memory.previous_confidence),
            self._told(current, memory.velocities, memory.confidence),
        )
        following, _ = self.network(*told, None, keys, rollout_step)
        with torch.autocast(current.positions.device.type, enabled=False):
            steps, positions = following.positions - current.positions, following.positions
            if self.adds_velocity:
                steps, positions = steps + memory.velocities, positions + memory.velocities
            velocities = torch.where(movable(current)[..., None], steps, 0.0)
        features = following.features[..., : self.feature_dim]
        known = VelocityMemory(velocities, memory.confidence, velocities, memory.confidence)
        return replace(current, positions=positions, features=features), known

    def _told(self, particles: Particles, velocities: Tensor, confidence: Tensor) -> Particles:
        """Return the particles with what a node is told appended to their features; zeros for what may not move."""
        may_move = movable(particles)[..., None]
        inputs = [velocities / self.network.location_scale, confidence[..., None], torch.ones_like(velocities[..., :1])]
        inputs = torch.where(may_move, torch.cat(inputs, dim=-1), 0.0).to(particles.features.dtype)
        return replace(particles, features=torch.cat([particles.features, inputs], dim=-1))
