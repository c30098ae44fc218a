"""A UNet encoder that predicts the depth of its pixels itself (paper section 5.2, "Predicted depth")."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.encoder.base import EncoderOutput
from vpd_lightning.encoder.networks.unet_network import UNetNetwork
from vpd_lightning.encoder.particles.unprojection import UnprojectingEncoder
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import RGBDFrames


class DepthPredictingEncoder(UnprojectingEncoder):
    """One more output of the UNet is the z-depth of the pixel in metres, positive by the softplus that follows.

    ``channels`` lists the widths of the features, as for ``UNetEncoder``; the output for the depth comes on top of the
    last one and is no feature. Particles lie at the predicted depth, in training and in use; the measured depth
    is never looked at. The prediction is offered as ``predicted_depth`` for a loss, and gets gradients from everything
    that looks at particle positions, too.

    # Paper: does not say how the output starts. Its bias starts at ``initial_depth`` metres, which should put pixels
    # into the workspace: softplus alone gives 0.69 m, where there may be no workspace at all, so nothing to learn from.
    """

    _empty_advice = "Set encoder.initial_depth to about the distance of the workspace's middle from the cameras."

    def __init__(
        self,
        *,
        channels: Sequence[int],
        num_particles: int,
        workspace_min: Sequence[float],
        workspace_max: Sequence[float],
        initial_depth: float,
        has_driven: bool,
    ):
        if not 0 < initial_depth < math.inf:
            raise ValueError(f"initial_depth must be a finite number of metres above 0, got {initial_depth}")
        network = UNetNetwork(channels=[*channels[:-1], channels[-1] + 1], in_channels=3)
        super().__init__(
            network=network,
            feature_dim=channels[-1],
            num_particles=num_particles,
            workspace_min=workspace_min,
            workspace_max=workspace_max,
            moving_fraction=None,
            background=None,
            use_normals=False,
            color_features=False,
            same_pixels=False,
            has_scenery=False,
            has_driven=has_driven,
        )
        last = network.up[-1]
        assert isinstance(last, nn.Conv2d) and last.bias is not None
        with torch.no_grad():  # softplus(x) = d where x = log(exp(d) - 1), written so that it holds for any d
            last.bias[-1] = initial_depth + math.log(-math.expm1(-initial_depth))

    def features_and_depth(
        self, rgb: Float[Tensor, "batch view height width 3"]
    ) -> tuple[Float[Tensor, "batch view height width feature"], Float[Tensor, "batch view height width"]]:
        """Return the features and the z-depth (metres) of every pixel, both positive."""
        outputs = self.network(rgb.flatten(0, 1).movedim(-1, 1)).movedim(1, -1)
        outputs = self._activate(outputs, rgb.dtype).unflatten(0, rgb.shape[:2])
        return outputs[..., :-1], outputs[..., -1]

    def forward(self, frames: RGBDFrames, keys: RandomKeys, purpose: str) -> EncoderOutput:
        """Encode the images of one time step (axes ``batch view``); their depth may hold anything.

        Raises:
            EmptyWorkspaceError: by its predicted depth no pixel of a batch member lies in the workspace.
        """
        rgb = self._colors(frames)
        features, depth = self.features_and_depth(rgb)

        def features_at(index: Tensor) -> Tensor:
            return torch.gather(features.flatten(1, 3), 1, index[..., None].expand(-1, -1, self.feature_dim))

        particles = self._particles(replace(frames, rgb=rgb, depth=depth), features_at, keys, purpose)
        return EncoderOutput(particles, {"predicted_depth": depth})
