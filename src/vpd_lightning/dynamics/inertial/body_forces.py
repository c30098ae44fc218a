"""The learned part of the inertial dynamics: forces on bodies from contact, weight and one another."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, Inertia, vectors_of
from vpd_lightning.dynamics.inertial.contact_search import ContactPoints, Contacts
from vpd_lightning.dynamics.inertial.flight import flight
from vpd_lightning.dynamics.inertial.rigid_motion import cross, rotate

_SHARE_IN_CONTACT = 0.03
"""Of the gradient of the common acceleration: bodies that lie there say less of it than of what carries them."""


class BodyForces(nn.Module):
    """A graph network of probes (particles) and bodies whose output acts as force and torque do.

    Probes send their state and contact to the bodies; bodies exchange messages; each body then places
    ``num_forces`` forces by attention over its probes. A force changes the body's displacement by itself, and its
    spin by the torque about the body's centre through the inverse inertia, so that a contact at a few particles
    moves and turns the whole body (Newton-Euler). One more force acts at the centre, without torque, as weight does,
    and one acceleration is the same for all bodies, always: what it is, and where it points, is learned. Forces are at
    most ``residual_share`` of ``force_scale`` (metres per step squared), which bounds the common acceleration:
    until that is learned, the other forces must not replace it. ``acceleration_gain`` multiplies the learning rate of
    the common acceleration: an update changes three numbers by less than it does the output of a network.
    Bodies farther than ``force_reach`` from all that they could touch (``flight``) feel nothing but it, and it is
    learned from them, nearly alone: else what is wrong with the support of bodies that lie there speaks against
    gravity, and forces that make up for both act on what falls. Null: all forces act everywhere.
    Damping scales the carried velocity: impacts and friction remove motion in proportion to it. Zero-initialised: no
    force, hardly any damping (0.7 % a step). Without ``is_damped`` motion ends by contact alone: taught by a few steps
    of pixels, damping makes up for what is not known yet, and slows what rolls and falls later on.
    """

    def __init__(
        self,
        *,
        hidden_dim: int,
        message_passing_steps: int,
        num_forces: int,
        location_scale: float,
        force_scale: float,
        residual_share: float,
        acceleration_gain: float,
        contact_range: float,
        force_reach: float | None,
        is_damped: bool,
    ):
        super().__init__()
        self.num_forces, self.contact_range, self.force_reach = num_forces, contact_range, force_reach
        self.location_scale, self.force_scale = location_scale, force_scale
        self.residual_scale = residual_share * force_scale
        self.acceleration_gain = acceleration_gain
        self.acceleration = nn.Parameter(torch.zeros(3))
        self.encode_probe = _mlp(19, hidden_dim, hidden_dim)
        self.encode_body = _mlp(2 * hidden_dim + 7, hidden_dim, hidden_dim)
        self.messages = nn.ModuleList(
            _mlp(2 * hidden_dim + 4, hidden_dim, hidden_dim) for _ in range(message_passing_steps)
        )
        self.updates = nn.ModuleList(_mlp(2 * hidden_dim, hidden_dim, hidden_dim) for _ in range(message_passing_steps))
        self.probe_query = nn.Linear(hidden_dim, hidden_dim)
        self.body_query = nn.Linear(hidden_dim, hidden_dim, bias=False)
        self.attention = nn.Linear(hidden_dim, num_forces)
        self.force = nn.Linear(hidden_dim, 3 * num_forces)
        self.offset_query = nn.Linear(3, hidden_dim, bias=False)
        self.damping = nn.Linear(hidden_dim, 2) if is_damped else None
        self.weight = nn.Linear(hidden_dim, 3)
        for layer in filter(None, (self.force, self.damping, self.weight)):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def common_acceleration(self) -> Float[Tensor, " 3"]:
        """Return what is the same for all bodies, metres per step squared."""
        return self.force_scale * torch.tanh(self.acceleration_gain * self.acceleration)

    def forward(
        self,
        displacements: Float[Tensor, "batch probe 3"],
        mask: Bool[Tensor, "batch probe"],
        points: ContactPoints,
        contacts: Contacts,
        motion: BodyMotion,
        inertia: Inertia,
    ) -> BodyMotion:
        """Return the corrected motion. Lengths are metres per step.

        ``points`` are all that may touch something, the probes first, and ``contacts`` is what is near them.
        """
        count = displacements.shape[1]
        positions, weights = points.positions[:, :count], points.members[..., :count]
        of_points, contacts = contacts, contacts.first(count)
        probe = self.encode_probe(self._probe_inputs(displacements, contacts)) * mask[..., None]
        share = weights / weights.sum(dim=-1, keepdim=True).clamp(min=1e-12)
        mean = torch.einsum("bap,bph->bah", share, probe)
        own = mask[:, None] & (weights > 0)
        peak = probe[:, None].masked_fill(~own[..., None], -torch.inf).amax(dim=2)
        peak = torch.where(own.any(dim=2)[..., None], peak, 0.0)
        clearance = self._clearance(contacts, mask, share)
        body = torch.cat([mean, peak, motion.displacements / self.location_scale, motion.spins, clearance], dim=-1)
        body = self.encode_body(body)
        relative = (motion.centers[:, :, None] - motion.centers[:, None]) / self.contact_range
        distance = relative.square().sum(dim=-1, keepdim=True).clamp(min=1e-12).sqrt()
        num_bodies = body.shape[1]
        there = (weights.sum(dim=-1) > 0).to(body.dtype)
        pair_weights = self._pair_weights(distance, there)
        for message, update in zip(self.messages, self.updates, strict=True):
            pair = [body[:, :, None].expand(-1, -1, num_bodies, -1), body[:, None].expand(-1, num_bodies, -1, -1)]
            received = (message(torch.cat([*pair, relative, distance], dim=-1)) * pair_weights).sum(dim=2)
            body = body + update(torch.cat([body, received], dim=-1))
        free = None
        if self.force_reach is not None:
            free = flight(points, of_points.distances, motion.centers, self.force_reach)
        return self._push(positions, share, probe, body, there, free, motion, inertia)

    def _pair_weights(
        self, distances: Float[Tensor, "batch body body 1"], there: Float[Tensor, "batch body"]
    ) -> Float[Tensor, "batch body body 1"]:
        """Return attention weights between bodies, largest to itself, falling to zero at ``contact_range``.

        So a body that is alone moves as one whose neighbours are far away, which training shows.
        """
        nearness = (1 - distances.square()).clamp(min=0).square() * there[:, None, :, None]
        return nearness / nearness.sum(dim=2, keepdim=True).clamp(min=1)

    def _probe_inputs(self, displacements: Tensor, contacts: Contacts) -> Tensor:
        normal_speed = (displacements * contacts.normals).sum(dim=-1, keepdim=True)
        tangential = displacements - normal_speed * contacts.normals
        gap = contacts.distances[..., None].clamp(-self.contact_range, self.contact_range)
        ahead = (gap + normal_speed).clamp(-self.contact_range, self.contact_range)
        widths = (0.05 * self.contact_range, 0.15 * self.contact_range)
        near = [torch.exp(-(value / width).square()) for value in (gap, ahead) for width in widths]
        lateral = (contacts.lateral[..., None] / self.contact_range).clamp(max=1)
        return torch.cat(
            [
                displacements / self.location_scale,
                tangential / self.location_scale,
                normal_speed / self.location_scale,
                gap / self.contact_range,
                ahead / self.location_scale,
                nn.functional.relu(-ahead) / self.location_scale,
                lateral,
                *near,
                contacts.normals,
                (contacts.normals.square().sum(dim=-1, keepdim=True) > 0.5).to(gap.dtype),
            ],
            dim=-1,
        )

    def _clearance(self, contacts: Contacts, mask: Tensor, share: Tensor) -> Tensor:
        """Smallest distance from the body's probes to a static surface, in units of ``contact_range``."""
        belongs = mask[:, None] & (share > 1e-3 * share.amax(dim=-1, keepdim=True))
        distances = contacts.distances[:, None].expand_as(share)
        lowest = distances.masked_fill(~belongs, self.contact_range).amin(dim=-1, keepdim=True)
        return lowest.clamp(-self.contact_range, self.contact_range) / self.contact_range

    def _push(
        self,
        positions: Tensor,
        share: Tensor,
        probe: Tensor,
        body: Tensor,
        there: Tensor,
        free: Tensor | None,
        motion: BodyMotion,
        inertia: Inertia,
    ) -> BodyMotion:
        # A probe acts on the body that it belongs to alone: pairs with all others would be most of the work of a step.
        own = share.argmax(dim=1)
        offsets = positions - vectors_of(motion.centers, own)
        pair = self.probe_query(probe) + vectors_of(self.body_query(body), own)
        pair = torch.relu(pair + self.offset_query(offsets / self.contact_range))
        logits = self.attention(pair)[:, None] + torch.log(share.clamp(min=1e-12))[..., None]
        attention = torch.softmax(logits, dim=2)  # batch body probe force
        forces = self.residual_scale * torch.tanh(self.force(pair)).unflatten(-1, (self.num_forces, 3))
        push = torch.einsum("bapf,bpfi->bai", attention, forces)
        torque = torch.einsum("bapf,bpfi->bai", attention, cross(offsets[:, :, None].expand_as(forces), forces))
        weight, common = self.residual_scale * torch.tanh(self.weight(body)), self.common_acceleration()
        # Nearly one at initialisation; it may remove motion, never add any: a long rollout cannot feed on itself.
        keep = None if self.damping is None else torch.sigmoid(self.damping(body) + 5.0)
        if free is not None:
            near = 1 - free
            push, torque, weight = push * near, torque * near, weight * near
            keep = None if keep is None else 1 - (1 - keep) * near
            common = common.detach() + (common - common.detach()) * free.clamp(min=_SHARE_IN_CONTACT)
        displacements, spins = motion.displacements, motion.spins
        if keep is not None:
            displacements, spins = displacements * keep[..., :1], spins * keep[..., 1:]
        weight, torque = (weight + common) * there[..., None], torque * there[..., None]
        return replace(
            motion,
            displacements=displacements + push * there[..., None] + weight,
            spins=spins + rotate(inertia.inverse_turning, torque),
        )


def _mlp(input_dim: int, hidden_dim: int, output_dim: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(input_dim, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, output_dim), nn.LayerNorm(output_dim)
    )
