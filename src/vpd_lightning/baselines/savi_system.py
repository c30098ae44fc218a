"""SAVi as a system: trained to reconstruct the frames of single views."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.baselines.seeded_dropout import seeded_dropout
from vpd_lightning.baselines.view_system import AbstractViewSystem
from vpd_lightning.types import SimulatorOutput, ViewBatch


class SAViSystem(AbstractViewSystem):
    """First training of SlotFormer (paper appendix, SlotFormer training): images to slots and back.

    It predicts that nothing moves: its predictor serves slot attention as a first guess, and is not trained to be
    decoded. Images of the first predicted steps thus show how well it reconstructs.
    """

    def forward(self, batch: ViewBatch) -> SimulatorOutput:
        """Reconstruct every frame of the batch from its corrected slots."""
        images = self.to_network(batch.images).to(next(self.parameters()).dtype)
        with seeded_dropout(batch.keys, "savi/dropout", images.device, enabled=self.training):
            slots, _ = self.savi.encode(images, None)
        return SimulatorOutput(self._unit_colors(slots), states=[])

    @torch.no_grad()
    def rollout_views(
        self, slots: Float[Tensor, "view time slot dim"], num_steps: int
    ) -> Float[Tensor, "view step slot dim"]:
        """Repeat the slots of the last given frame."""
        self._require_context(slots)
        return slots[:, -1:].expand(-1, num_steps, -1, -1)
