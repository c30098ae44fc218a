"""Keeps a running average of the weights beside those that are trained; validations and checkpoints use it."""

from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor

from vpd_lightning.training.averaging import share_kept

CURRENT = "current_model_state"
"""Where a checkpoint keeps the weights that training goes on with; its ``state_dict`` is the average."""


class AverageWeights(WeightAveraging):
    """An exponential moving average of all parameters, taken after every update.

    After ``n`` updates the average keeps the share ``min(decay, (1 + n) / (warmup + n))`` of itself, so that it forgets
    the first weights however short the training is. Until ``decay`` is reached that is an average over about the last
    ``1 / (warmup - 1)`` of all updates; from there on over the last ``1 / (1 - decay)``. Buffers are those of the
    trained system.

    Checkpoints hold the average where everything looks for weights, and what training goes on with beside it: a run
    that is resumed without this callback starts from the average.
    """

    # Paper: evaluates the weights of the last update.

    def __init__(self, *, decay: float, warmup: float) -> None:
        if not 0.0 < decay < 1.0 or warmup < 1:
            raise ValueError(f"decay must lie between 0 and 1 and warmup be at least 1, got {decay} and {warmup}")
        super().__init__(use_buffers=False, multi_avg_fn=self._take_in)
        self.decay, self.warmup = decay, warmup
        self._is_swapped = False

    def _take_in(self, averages: list[Tensor], current: list[Tensor], num_averaged: Tensor) -> None:
        torch._foreach_lerp_(averages, current, 1.0 - self.share_kept(int(num_averaged)))

    def share_kept(self, num_averaged: int) -> float:
        """Return how much of the average of that many weights stays when the next ones are taken in."""
        return share_kept(num_averaged, self.decay, self.warmup)

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Follow the system to its device, on which it was not yet when its copy was made."""
        assert self._average_model is not None
        self._average_model.to(pl_module.device)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Leave the trained weights where they are: the checkpoint that follows must be one to go on from."""

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Put the average in the place of the weights, in the middle of a validation as well."""
        super().on_save_checkpoint(trainer, pl_module, checkpoint)
        if self._is_swapped:
            checkpoint["state_dict"], checkpoint[CURRENT] = checkpoint[CURRENT], checkpoint["state_dict"]

    def _swap_models(self, pl_module: pl.LightningModule) -> None:
        super()._swap_models(pl_module)
        self._is_swapped = not self._is_swapped
