"""The learned part of the inertial dynamics: forces on bodies from contact, weight and one another."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vpd_lightning.dynamics.contact import Contacts
from vpd_lightning.dynamics.rigid_motion import Twists, cross, rotate


class BodyForces(nn.Module):
    """A graph network of probes (particles) and anchors whose output acts as force and torque do.

    Probes send their state and contact to the anchors; anchors exchange messages; each anchor then places
    ``num_forces`` forces by attention over its probes. A force changes the anchor's displacement by itself, and its
    spin by the torque about the anchor's centre through the inverse inertia, so that a contact at a few particles
    moves and turns the whole body (Newton-Euler). One more force acts at the centre, without torque, as weight does.
    Damping scales what was carried: impacts and friction remove motion
    in proportion to it. Zero-initialised: no force, hardly any damping (0.7 % a step).
    """

    def __init__(
        self, *, hidden_dim: int, message_passing_steps: int, num_forces: int, scale: float, contact_range: float
    ):
        super().__init__()
        self.num_forces, self.scale, self.contact_range = num_forces, scale, contact_range
        self.encode_probe = _mlp(19, hidden_dim, hidden_dim)
        self.encode_anchor = _mlp(2 * hidden_dim + 7, hidden_dim, hidden_dim)
        self.messages = nn.ModuleList(
            _mlp(2 * hidden_dim + 4, hidden_dim, hidden_dim) for _ in range(message_passing_steps)
        )
        self.updates = nn.ModuleList(_mlp(2 * hidden_dim, hidden_dim, hidden_dim) for _ in range(message_passing_steps))
        self.probe_query = nn.Linear(hidden_dim, hidden_dim)
        self.anchor_query = nn.Linear(hidden_dim, hidden_dim, bias=False)
        self.attention = nn.Linear(hidden_dim, num_forces)
        self.force = nn.Linear(hidden_dim, 3 * num_forces)
        self.offset_query = nn.Linear(3, hidden_dim, bias=False)
        self.damping = nn.Linear(hidden_dim, 2)
        self.weight = nn.Linear(hidden_dim, 3)
        for layer in (self.force, self.damping, self.weight):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(
        self,
        positions: Float[Tensor, "batch probe 3"],
        displacements: Float[Tensor, "batch probe 3"],
        contacts: Contacts,
        mask: Bool[Tensor, "batch probe"],
        weights: Float[Tensor, "batch anchor probe"],
        twists: Twists,
        inverse_inertia: Float[Tensor, "batch anchor 3 3"],
    ) -> Twists:
        """Return the corrected twists. Lengths are metres per step; weights say which probes belong to an anchor."""
        probe = self.encode_probe(self._probe_inputs(displacements, contacts)) * mask[..., None]
        share = weights / weights.sum(dim=-1, keepdim=True).clamp(min=1e-12)
        mean = torch.einsum("bap,bph->bah", share, probe)
        gate = (share / share.amax(dim=-1, keepdim=True).clamp(min=1e-12))[..., None]
        # Padding must not win the maximum with its zero; an anchor without any probe gets zero.
        peak = (probe[:, None] * gate).masked_fill(~mask[:, None, :, None], -torch.inf).amax(dim=2)
        peak = torch.where(mask.any(dim=1)[:, None, None], peak, 0.0)
        clearance = self._clearance(contacts, mask, share)
        anchor = torch.cat([mean, peak, twists.displacements / self.scale, twists.spins, clearance], dim=-1)
        anchor = self.encode_anchor(anchor)
        relative = twists.centers[:, :, None] - twists.centers[:, None]
        distance = relative.square().sum(dim=-1, keepdim=True).clamp(min=1e-12).sqrt()
        count = anchor.shape[1]
        for message, update in zip(self.messages, self.updates, strict=True):
            pair = [anchor[:, :, None].expand(-1, -1, count, -1), anchor[:, None].expand(-1, count, -1, -1)]
            received = message(torch.cat([*pair, relative, distance], dim=-1)).mean(dim=2)
            anchor = anchor + update(torch.cat([anchor, received], dim=-1))
        return self._push(positions, share, probe, anchor, twists, inverse_inertia)

    def _probe_inputs(self, displacements: Tensor, contacts: Contacts) -> Tensor:
        normal_speed = (displacements * contacts.normals).sum(dim=-1, keepdim=True)
        tangential = displacements - normal_speed * contacts.normals
        gap = contacts.distances[..., None].clamp(-self.contact_range, self.contact_range)
        ahead = (gap + normal_speed).clamp(-self.contact_range, self.contact_range)
        near = [torch.exp(-(value / width).square()) for value in (gap, ahead) for width in (0.05, 0.15)]
        lateral = (contacts.lateral[..., None] / self.contact_range).clamp(max=1)
        return torch.cat(
            [
                displacements / self.scale,
                tangential / self.scale,
                normal_speed / self.scale,
                gap / self.contact_range,
                ahead / self.scale,
                nn.functional.relu(-ahead) / self.scale,
                lateral,
                *near,
                contacts.normals,
                (contacts.normals.square().sum(dim=-1, keepdim=True) > 0.5).to(gap.dtype),
            ],
            dim=-1,
        )

    def _clearance(self, contacts: Contacts, mask: Tensor, share: Tensor) -> Tensor:
        """Lowest distance of the anchor's probes to what stands still: is anything touching at all?"""
        belongs = mask[:, None] & (share > 1e-3 * share.amax(dim=-1, keepdim=True))
        distances = contacts.distances[:, None].expand_as(share)
        lowest = distances.masked_fill(~belongs, self.contact_range).amin(dim=-1, keepdim=True)
        return lowest.clamp(-self.contact_range, self.contact_range) / self.contact_range

    def _push(
        self,
        positions: Tensor,
        share: Tensor,
        probe: Tensor,
        anchor: Tensor,
        twists: Twists,
        inverse_inertia: Tensor,
    ) -> Twists:
        offsets = positions[:, None] - twists.centers[:, :, None]
        pair = self.probe_query(probe)[:, None] + self.anchor_query(anchor)[:, :, None]
        pair = torch.relu(pair + self.offset_query(offsets / self.scale))
        logits = self.attention(pair) + torch.log(share.clamp(min=1e-12))[..., None]
        attention = torch.softmax(logits, dim=2)  # batch anchor probe force
        forces = self.scale * torch.tanh(self.force(pair)).unflatten(-1, (self.num_forces, 3))
        forces = attention[..., None] * forces
        push = forces.sum(dim=(2, 3))
        torque = cross(offsets, forces.sum(dim=3)).sum(dim=2)
        # Nearly one at initialisation; it may remove motion, never add any: a long rollout cannot feed on itself.
        keep = torch.sigmoid(self.damping(anchor) + 5.0)
        return Twists(
            centers=twists.centers,
            displacements=twists.displacements * keep[..., :1] + push + self.scale * torch.tanh(self.weight(anchor)),
            spins=twists.spins * keep[..., 1:] + rotate(inverse_inertia, torque),
        )


def _mlp(input_dim: int, hidden_dim: int, output_dim: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(input_dim, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, output_dim), nn.LayerNorm(output_dim)
    )
