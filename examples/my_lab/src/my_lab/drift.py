"""Every particle goes on as it went, corrected by a small network."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles


@dataclass(frozen=True)
class DriftMemory:
    """Displacement of every particle in the last step (metres)."""

    displacements: Tensor  # batch particle 3


class DriftDynamics(AbstractDynamics):
    """The first displacement is guessed from the particles nearby in the previous frame, then carried exactly."""

    def __init__(self, *, feature_dim: int, hidden_dim: int, match_scale: float, location_scale: float):
        super().__init__()
        if not (match_scale > 0 and location_scale > 0):
            raise ValueError(f"scales must be positive, got {match_scale} and {location_scale}")
        self.match_scale, self.location_scale = match_scale, location_scale
        self.network = nn.Sequential(
            nn.Linear(feature_dim + 3, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, feature_dim + 3)
        )

    def initialize(self, previous: Particles, current: Particles, keys: RandomKeys) -> DriftMemory:
        offsets = current.positions[:, :, None] - previous.positions[:, None]
        weights = torch.exp(-offsets.square().sum(dim=-1) / (2 * self.match_scale**2)) * previous.mask[:, None]
        mean = (weights[..., None] * offsets).sum(dim=2) / weights.sum(dim=2).clamp(min=1e-6)[..., None]
        return DriftMemory(mean)

    def forward(
        self, previous: Particles, current: Particles, memory: DriftMemory, keys: RandomKeys, rollout_step: int
    ) -> tuple[Particles, DriftMemory]:
        seen = torch.cat([memory.displacements / self.location_scale, current.features], dim=-1)
        change = self.network(seen)
        step = memory.displacements + self.location_scale * torch.tanh(change[..., :3])
        step = torch.where(current.mask[..., None], step, 0.0)
        following = replace(current, positions=current.positions + step, features=current.features + change[..., 3:])
        return following, DriftMemory(step)
