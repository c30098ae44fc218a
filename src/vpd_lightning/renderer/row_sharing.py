"""One evaluation of the network for all samples of a ray that (almost) no particle reaches."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.renderer.field.radiance_field import RadianceField


class SharedRows:
    """Which samples have features of their own, and which take the row of their ray whose features are zero.

    A sample shares when none of its features exceeds ``threshold`` in absolute value. Its density and colour are then
    off by at most what ``bounds.feature_noise_error`` derives. With a threshold of 0 they are exact.

    The gradients of all samples that share a row are summed into it, so those of the network are exact at the threshold
    0. No gradient reaches the particles through a shared row: at 0 that changes something only where a particle is in
    reach and all its features are exactly zero.

    How many rows are left depends on the numbers, so making one waits for the device.
    """

    def __init__(self, features: Float[Tensor, "*batch sample feature"], threshold: float) -> None:
        with torch.no_grad():
            has_own = (features.abs() > threshold).any(dim=-1)
            self._shape = has_own.shape
            num_samples = self._shape[-1]
            num_rays = has_own.numel() // max(1, num_samples)
            self._own = has_own.flatten().nonzero()[:, 0]
            # Of each sample: its own row, or, behind all of those, the shared row of its ray.
            shared = len(self._own) + torch.arange(num_rays, device=features.device)
            source = shared[:, None].expand(num_rays, num_samples).flatten()
            self._source = source.index_copy(0, self._own, torch.arange(len(self._own), device=features.device))
            ray = torch.arange(num_rays, device=features.device)
            self._ray = torch.cat([self._own // max(1, num_samples), ray])
        self.num_samples = has_own.numel()
        """How many samples there are."""
        self.num_saved = self.num_samples - len(self._ray)
        """How many rows fewer than samples the network evaluates; below zero where hardly any sample shares."""

    def evaluate(
        self,
        field: RadianceField,
        features: Float[Tensor, "*batch sample feature"],
        directions: Float[Tensor, "*batch 3"] | None,
        use_color: bool,
    ) -> tuple[Float[Tensor, "*batch sample"], Float[Tensor, "*batch sample 3"] | None]:
        """Return what ``field`` says of the samples; each row goes through it as a ray with one sample."""
        rows = features.reshape(-1, features.shape[-1]).index_select(0, self._own)
        rows = torch.cat([rows, rows.new_zeros(len(self._ray) - len(self._own), rows.shape[1])])
        if directions is not None:
            directions = directions.reshape(-1, 3).index_select(0, self._ray)
        sigmas, rgbs = field(rows[:, None], directions, use_color)
        sigmas = sigmas[:, 0].index_select(0, self._source).view(self._shape)
        return sigmas, None if rgbs is None else rgbs[:, 0].index_select(0, self._source).view(*self._shape, 3)
