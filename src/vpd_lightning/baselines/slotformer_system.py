"""SlotFormer as a system: dynamics of stored slots, supervised by slots and by images of a frozen decoder."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.baselines.rollouter import SlotRollouter
from vpd_lightning.baselines.savi import SAVi
from vpd_lightning.baselines.seeded_dropout import seeded_dropout
from vpd_lightning.baselines.view_system import AbstractViewSystem
from vpd_lightning.types import SimulatorOutput, ViewBatch


class SlotFormerSystem(AbstractViewSystem):
    """Second training of SlotFormer (Wu et al. 2023): ``rollouter`` learns, ``savi`` is frozen and always evaluates.

    The slots of a batch must come from the same SAVi weights.
    """

    def __init__(self, *, savi: SAVi, rollouter: SlotRollouter):
        super().__init__(savi=savi, num_context_frames=rollouter.num_history)
        self.rollouter = rollouter
        self.savi.requires_grad_(False)
        self.savi.eval()

    def train(self, mode: bool = True) -> "SlotFormerSystem":
        """Switch the rollouter only."""
        super().train(mode)
        self.savi.eval()
        return self

    def forward(self, batch: ViewBatch) -> SimulatorOutput:
        """Predict the slots behind the history and their images.

        ``auxiliary`` holds ``predicted_slots`` and ``target_slots``, axes ``batch step slot dim``; they correspond by
        index, which the slots of one video keep.
        """
        if batch.slots is None:
            raise ValueError("SlotFormer trains on stored slots, and the batch has none; extract them first")
        history, target = batch.slots[:, : batch.num_history], batch.slots[:, batch.num_history :]
        with seeded_dropout(batch.keys, "rollouter/dropout", history.device, enabled=self.training):
            predicted = self.rollouter(history, target.shape[1])
        # Not under no_grad: the error of the images reaches the rollouter through the frozen decoder.
        rendered = self._unit_colors(predicted)
        return SimulatorOutput(rendered, states=[], auxiliary={"predicted_slots": predicted, "target_slots": target})

    @torch.no_grad()
    def rollout_views(
        self, slots: Float[Tensor, "view time slot dim"], num_steps: int
    ) -> Float[Tensor, "view step slot dim"]:
        """Predict from the slots of ``num_context_frames`` frames, step by step from its own predictions."""
        self.eval()
        self._require_context(slots)
        return self.rollouter(slots.to(next(self.parameters())), num_steps)
