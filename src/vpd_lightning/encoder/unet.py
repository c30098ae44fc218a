"""UNet features at unprojected pixels, cropped to the workspace and subsampled: RGBDFrames -> Particles (paper 3.1)."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.encoder.base import AbstractBackground, EncoderOutput
from vpd_lightning.encoder.networks.unet_network import UNetNetwork
from vpd_lightning.encoder.particles.unprojection import UnprojectingEncoder
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import RGBDFrames

# Share of pixels below which the last convolution is gathered at the chosen ones (measured on a CPU): at 8 % of the
# pixels that is four times faster than convolving all of them, at 100 % ten times slower. Same numbers either way.
_GATHER_BELOW = 0.1


class UNetEncoder(UnprojectingEncoder):
    """Each pixel inside the workspace becomes a particle (position by depth, features by the UNet of the RGB image).

    The UNet sees RGB only and shares its weights over cameras. Which pixels: see ``UnprojectingEncoder``.
    """

    def __init__(
        self,
        *,
        channels: Sequence[int],
        num_particles: int,
        workspace_min: Sequence[float],
        workspace_max: Sequence[float],
        moving_fraction: float | None,
        background: AbstractBackground | None,
        use_normals: bool,
        color_features: bool,
        same_pixels: bool,
        has_scenery: bool,
        has_driven: bool,
    ):
        super().__init__(
            network=UNetNetwork(channels=channels, in_channels=3),
            feature_dim=channels[-1],
            num_particles=num_particles,
            workspace_min=workspace_min,
            workspace_max=workspace_max,
            moving_fraction=moving_fraction,
            background=background,
            use_normals=use_normals,
            color_features=color_features,
            same_pixels=same_pixels,
            has_scenery=has_scenery,
            has_driven=has_driven,
        )

    def pixel_features(self, rgb: Float[Tensor, "*shape height width 3"]) -> Tensor:
        """Return features of every pixel, axes ``... height width feature``; softplus keeps them positive."""
        features = self.network(rgb.flatten(0, -4).movedim(-1, 1)).movedim(1, -1)
        return self._activate(features, rgb.dtype).reshape(*rgb.shape[:-1], self.feature_dim)

    def _features_at(self, rgb: Float[Tensor, "batch view height width 3"], index: Tensor) -> Tensor:
        """Return the features of the chosen pixels; ``index`` counts over ``view height width`` of each member."""
        pixels_per_member = rgb[0, ..., 0].numel()
        if index.shape[1] > _GATHER_BELOW * pixels_per_member:
            every = self.pixel_features(rgb).flatten(1, 3)
            return torch.gather(every, 1, index[..., None].expand(-1, -1, self.feature_dim))
        member = torch.arange(len(rgb), device=index.device)[:, None]
        pixels = (member * pixels_per_member + index).flatten()
        features = self.network.at_pixels(rgb.flatten(0, 1).movedim(-1, 1), pixels)
        return self._activate(features, rgb.dtype).reshape(*index.shape, self.feature_dim)

    def forward(self, frames: RGBDFrames, keys: RandomKeys, purpose: str) -> EncoderOutput:
        """Encode the frames of one time step (axes ``batch view``).

        Raises:
            EmptyWorkspaceError: no measured pixel of a batch member lies in the workspace.
        """
        rgb = self._colors(frames)
        colored = replace(frames, rgb=rgb)
        return EncoderOutput(self._particles(colored, lambda index: self._features_at(rgb, index), keys, purpose))
