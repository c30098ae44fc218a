"""Tells times apart, not cameras: the time-contrastive loss of NeRF-dy on the features of single views."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.types import SimulatorOutput, VideoBatch

_HINT = "Set model=global for such an encoder, and scene.input_views to at least two cameras; or loss=pixel."


class TimeContrastiveLoss(AbstractLoss):
    """Hinge on squared distances of unit features: another view of the same time must lie nearer than another time.

    For every feature ``a`` of a view at a time, every other view ``p`` of that time, and the same view ``n`` at the
    other context frame: ``max(|a - p|^2 - |a - n|^2 + margin, 0)``, averaged over a member's triples, then over members
    (Li et al. 2021, "3D Neural Scene Representations for Visuomotor Control", after Sermanet et al. 2018).
    """

    # The paper of VPD says nothing of this term for its baseline. NeRF-dy gives no margin, and is not clear about where
    # the features are taken: here behind the network that has seen the camera.

    name = "time_contrastive"

    def __init__(self, *, weight: float, margin: float):
        super().__init__()
        if weight < 0 or margin <= 0:
            raise ValueError(f"weight must not be negative and margin must be above 0, got {weight} and {margin}")
        self.weight, self.margin = weight, margin

    def forward(self, output: SimulatorOutput, batch: VideoBatch) -> Float[Tensor, ""]:
        """Return the mean hinge.

        Raises:
            ConfigError: the encoder offers no features of single views, or there is one view only.
        """
        names = ("previous_view_features", "view_features")
        missing = [name for name in names if name not in output.auxiliary]
        if missing:
            raise ConfigError(f"the loss {self.name} needs an encoder that tells the features of every view.\n{_HINT}")
        features = torch.stack([nn.functional.normalize(output.auxiliary[name], dim=-1) for name in names], dim=1)
        num_views = features.shape[2]  # axes: batch time view feature
        if num_views < 2:
            raise ConfigError(f"the loss {self.name} compares input views, and there is only {num_views}.\n{_HINT}")
        to_views = (features[:, :, :, None] - features[:, :, None]).square().sum(dim=-1)  # batch time view other_view
        to_time = (features[:, 0] - features[:, 1]).square().sum(dim=-1)  # batch view
        hinge = (to_views - to_time[:, None, :, None] + self.margin).clamp(min=0)
        others = ~torch.eye(num_views, dtype=torch.bool, device=features.device)
        return hinge[:, :, others].mean()
