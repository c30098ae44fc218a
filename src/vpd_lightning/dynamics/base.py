"""The contract of stage 3b: the previous and the current particles in, the next particles out."""

from abc import ABC, abstractmethod
from typing import Any

from torch import nn

from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles


class AbstractDynamics(nn.Module, ABC):
    """Predicts the next particles; predicted particle i is current particle i plus its own change.

    Only the two observed frames lack correspondences. What a dynamics wants to carry from step to step is its
    ``memory``: plain tensors in a dataclass, rebuildable from any pair of particle sets, so that edits rebuild it.

    One that takes actions has an attribute ``has_driven`` that is true, and finds what is driven in
    ``current.driven``, with where it will be after the step in ``next_positions`` and ``next_normals``. What it
    returns of that does not matter: the simulator puts it where it was given to be.
    """

    def initialize(self, previous: Particles, current: Particles, keys: RandomKeys) -> Any:
        """Build the memory from the two observed frames; the paper's dynamics needs none."""
        return None

    def completed(self, previous: Particles, current: Particles, keys: RandomKeys) -> Particles:
        """Return the current particles with what the dynamics guesses beside them to be drawn; here nothing."""
        return current

    @abstractmethod
    def forward(
        self, previous: Particles, current: Particles, memory: Any, keys: RandomKeys, rollout_step: int
    ) -> tuple[Particles, Any]:
        """Return the particles of the next step and the new memory; ``rollout_step`` counts from 0."""
