"""Squared error of a predicted depth (paper section on predicted depth)."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.types import SimulatorOutput, VideoBatch


class PredictedDepthLoss(AbstractLoss):
    """Mean squared error (square metres) of the z-depth that the encoder predicts for the current context frame.

    Averaged over the measured pixels of a member's input views (finite, above 0, at most ``far`` metres), then over
    members, so that a batch is worth the same however it is spread over devices. ``predicted_depth_error`` is the mean
    absolute error in metres, averaged likewise.
    """

    # Paper: weight, mask and frames are our choice; it says "MSE loss on the training images".

    name = "predicted_depth"

    def __init__(self, *, weight: float, far: float):
        super().__init__()
        if weight < 0 or far <= 0:
            raise ValueError(f"weight must not be negative and far must be above 0, got weight={weight}, far={far}")
        self.weight, self.far = weight, far
        self._metrics: dict[str, Tensor] = {}

    @property
    def metrics(self) -> dict[str, Tensor]:
        """The error of the last call in metres."""
        return self._metrics

    def forward(self, output: SimulatorOutput, batch: VideoBatch) -> Float[Tensor, ""]:
        """Return the error.

        Raises:
            ConfigError: the encoder predicts no depth.
        """
        predicted = output.auxiliary.get("predicted_depth")
        if predicted is None:
            raise ConfigError(
                "the loss predicted_depth needs an encoder that predicts depth.\n"
                "Set encoder=unet_depth (or unet_depth_small), or loss=pixel."
            )
        truth = batch.context.depth[:, 1].to(predicted.dtype)
        valid = torch.isfinite(truth) & (truth > 0) & (truth <= self.far)
        error = torch.where(valid, predicted - torch.where(valid, truth, 0.0), 0.0).flatten(1)
        count = valid.flatten(1).sum(dim=1).clamp(min=1)
        self._metrics = {"predicted_depth_error": (error.detach().abs().sum(dim=1) / count).mean()}
        return (error.square().sum(dim=1) / count).mean()
