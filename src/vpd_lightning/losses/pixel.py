"""Squared pixel error of rendered rays (paper equation 3)."""

from jaxtyping import Float
from torch import Tensor

from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.types import SimulatorOutput, VideoBatch, ViewBatch


class PixelLoss(AbstractLoss):
    """Mean squared colour error over steps and rays, plus ``coarse_weight`` times that of the coarse tier."""

    name = "pixel"

    def __init__(self, *, weight: float, coarse_weight: float):
        super().__init__()
        if weight < 0 or coarse_weight < 0:
            raise ValueError(f"weights must not be negative, got weight={weight}, coarse_weight={coarse_weight}")
        self.weight, self.coarse_weight = weight, coarse_weight

    def forward(self, output: SimulatorOutput, batch: VideoBatch | ViewBatch) -> Float[Tensor, ""]:
        """Return the error; colours are in [0, 1]."""
        if output.rendered is None:
            raise ConfigError("the pixel loss needs rendered rays, and this system renders none in training.")
        loss = (output.rendered.rgbs - batch.rgbs).square().mean()
        if output.rendered.coarse_rgbs is not None:
            # Paper: does not mention the coarse tier's loss; jaxnerf, on which it builds, adds it with weight 1.
            loss = loss + self.coarse_weight * (output.rendered.coarse_rgbs - batch.rgbs).square().mean()
        return loss
