"""The contract of stage 4: particles and rays in, rendered rays out."""

from abc import ABC, abstractmethod

from torch import nn

from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles, Rays, RenderedRays


class AbstractRenderer(nn.Module, ABC):
    """Renders rays of a particle scene; all time steps of a rollout come as one batch axis."""

    @abstractmethod
    def forward(self, particles: Particles, rays: Rays, keys: RandomKeys | None) -> RenderedRays:
        """Render ``rays`` (``batch ray 3``) of ``particles`` (``batch particle ...``).

        ``keys`` (one sample index per member of the batch axis) drives random sampling along rays in training;
        ``None`` renders without randomness.
        """
