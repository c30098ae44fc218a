"""Squared error of predicted slots (SlotFormer's first loss)."""

from jaxtyping import Float
from torch import Tensor

from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.types import SimulatorOutput, VideoBatch, ViewBatch


class SlotLoss(AbstractLoss):
    """Mean squared error over steps, slots and channels; slots correspond by index, nothing is matched.

    The system offers ``predicted_slots`` and ``target_slots``, axes ``batch step slot dim``. The targets are given: no
    gradient reaches what made them.
    """

    name = "slot"

    def __init__(self, *, weight: float):
        super().__init__()
        if weight < 0:
            raise ValueError(f"weight must not be negative, got {weight}")
        self.weight = weight

    def forward(self, output: SimulatorOutput, batch: VideoBatch | ViewBatch) -> Float[Tensor, ""]:
        """Return the error in the units of the slots."""
        missing = [name for name in ("predicted_slots", "target_slots") if name not in output.auxiliary]
        if missing:
            raise ConfigError(f"the slot loss needs {missing[0]}, and this system has none.\nUse it with slotformer.")
        predicted, target = output.auxiliary["predicted_slots"], output.auxiliary["target_slots"].detach()
        if predicted.shape != target.shape:
            raise ValueError(f"predicted slots have shape {tuple(predicted.shape)}, stored ones {tuple(target.shape)}")
        return (predicted - target).square().mean()
