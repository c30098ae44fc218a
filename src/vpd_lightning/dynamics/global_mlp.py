"""A plain network that moves the scene vector on: what a scene without particles has for dynamics (Li et al. 2021)."""

from dataclasses import replace
from typing import Any

import torch
from torch import nn

from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.blocks import MLP
from vpd_lightning.finite import require_finite
from vpd_lightning.graph.pooling import mean_features
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles


class GlobalMLPDynamics(AbstractDynamics):
    """``s_{t+1} = normalize(s_t + MLP([s_{t-1}; s_t]))``; positions stay, and nothing depends on them.

    The MLP has ``num_hidden_layers`` layers of ``hidden_dim`` with ReLU behind each and a linear one to the width of
    the scene vector. Initially it predicts no change. Meant for the one particle of ``GlobalSceneEncoder``; of
    several particles the mean counts, and every one of them gets the same change.
    """

    # Paper: "an MLP" as in NeRF-dy, which has actions and sees one state; without actions the velocity needs two. The
    # sum with s_t (as in the paper's own dynamics), the unit length and the sizes are ours.

    def __init__(self, *, feature_dim: int, hidden_dim: int, num_hidden_layers: int) -> None:
        super().__init__()
        sizes = {"feature_dim": feature_dim, "hidden_dim": hidden_dim, "num_hidden_layers": num_hidden_layers}
        for name, value in sizes.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}.")
        self.network = MLP(2 * feature_dim, [hidden_dim] * num_hidden_layers + [feature_dim])
        nn.init.zeros_(self.network.layers[-1].weight)

    def forward(
        self, previous: Particles, current: Particles, memory: Any, keys: RandomKeys, rollout_step: int
    ) -> tuple[Particles, Any]:
        """Return the particles of the next step, their features of unit length; there is no memory."""
        previous, current = previous.without_padding(), current.without_padding()
        require_finite(
            "Dynamics", **{"features of both frames": torch.cat([previous.features, current.features], dim=-2)}
        )
        change = self.network(torch.cat([mean_features(previous), mean_features(current)], dim=-1))
        features = current.features + change[..., None, :].to(current.features.dtype)
        return replace(current, features=nn.functional.normalize(features, dim=-1)), memory
