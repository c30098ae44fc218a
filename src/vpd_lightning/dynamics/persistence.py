"""The simplest prediction: nothing changes."""

from typing import Any

from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles


class PersistenceDynamics(AbstractDynamics):
    """Returns the current particles; a reference for every other dynamics, and a way to train encoder and renderer."""

    def forward(
        self, previous: Particles, current: Particles, memory: Any, keys: RandomKeys, rollout_step: int
    ) -> tuple[Particles, Any]:
        """Return ``current`` and ``memory`` as they are."""
        return current, memory
