"""Bodies hold together: distances between neighbouring particles of a rollout should stay what they are."""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.types import Particles, SimulatorOutput, VideoBatch

_NEAREST = 1 / 6
"""Share of the radius below which a pair is left out: its relative change would be rounding and noise."""


class RigidityLoss(AbstractLoss):
    """Mean of ``x / (x + softness^2)`` over pairs and steps; x is the squared relative change of a pair's distance.

    Pairs are those of the ``num_particles`` particles that the rollout moves farthest with ``num_neighbors`` others
    each, drawn from those within ``radius`` (metres) in the first predicted state, with which later ones are compared.
    A pair whose distance changes by much more than the share ``softness`` costs nearly the same however far it parts
    (Geman and McClure's function): a body may leave the floor, and soft ones may bend.

    What particles are, and which of them belong together, is not known; only the model's own prediction is looked at.
    """

    # Paper: has no such loss. With it the graph network's bodies grow less over long rollouts; see docs/notes.md.

    name = "rigidity"

    def __init__(self, *, weight: float, radius: float, softness: float, num_particles: int, num_neighbors: int):
        super().__init__()
        if weight < 0 or min(radius, softness) <= 0 or min(num_particles, num_neighbors) < 1:
            raise ValueError(
                "weight must not be negative, radius and softness must be positive, num_particles and num_neighbors at "
                f"least 1; got {weight}, {radius}, {softness}, {num_particles}, {num_neighbors}"
            )
        self.weight, self.radius, self.softness = weight, radius, softness
        self.num_particles, self.num_neighbors = num_particles, num_neighbors

    def forward(self, output: SimulatorOutput, batch: VideoBatch) -> Float[Tensor, ""]:
        """Return the mean; 0 where a single step is predicted or no two particles are near each other."""
        if len(output.states) < 2:  # as in the training of an auto-encoder
            return batch.rgbs.new_zeros(())
        first, *later = output.states
        with torch.autocast(first.positions.device.type, enabled=False):
            one, other, valid = self._pairs(first, later[-1], batch)
            start = _distance(first, one, other).detach().clamp(min=_NEAREST * self.radius)
            count = valid.sum().clamp(min=1)
            total = []
            for state in later:
                change = (_distance(state, one, other) / start - 1).square()
                cost = change / (change + self.softness**2)
                total.append(torch.where(valid, cost, 0.0).sum() / count)
            return torch.stack(total).mean()

    @torch.no_grad()
    def _pairs(
        self, first: Particles, last: Particles, batch: VideoBatch
    ) -> tuple[Int64[Tensor, "batch pair"], Int64[Tensor, "batch pair"], Bool[Tensor, "batch pair"]]:
        """Return both ends of each pair, and which pairs there are."""
        positions, mask = first.positions.detach(), first.mask
        moved = (last.positions - positions).norm(dim=-1).masked_fill(~mask, -1.0)
        chosen = moved.topk(min(self.num_particles, mask.shape[1]), dim=1).indices
        near = positions.gather(1, chosen[..., None].expand(-1, -1, 3))[:, :, None] - positions[:, None]
        distance = near.square().sum(dim=-1).sqrt()
        is_pair = (distance < self.radius) & (distance > _NEAREST * self.radius)
        is_pair &= mask[:, None] & mask.gather(1, chosen)[..., None]
        draws = torch.stack([torch.rand(mask.shape[1], generator=g) for g in batch.keys.generators("rigidity")])
        order = draws.to(positions)[:, None].masked_fill(~is_pair, -1.0)
        value, other = order.topk(min(self.num_neighbors, mask.shape[1]), dim=2)
        valid = value >= 0
        one = chosen[..., None].expand_as(other)
        other = torch.where(valid, other, one)  # never a particle of the padding
        return one.flatten(1), other.flatten(1), valid.flatten(1)


def _distance(state: Particles, one: Tensor, other: Tensor) -> Float[Tensor, "batch pair"]:
    ends = [state.positions.gather(1, index[..., None].expand(-1, -1, 3)) for index in (one, other)]
    square = (ends[0] - ends[1]).square().sum(dim=-1)
    return (square + torch.finfo(square.dtype).tiny).sqrt()  # with a gradient, also where two particles meet
