"""SAVi's image encoder: one image to a set of tokens."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.baselines.soft_position import SoftPositionEmbedding


class SAViEncoder(nn.Module):
    """Convolutions without normalisation (``channels`` lists their output widths), positions, and an MLP per pixel.

    Only the first convolution may have a stride, ``first_stride``; the last one is linear.
    """

    def __init__(
        self, *, resolution: int, channels: Sequence[int], kernel_size: int, first_stride: int, token_dim: int
    ):
        super().__init__()
        if len(channels) < 1 or min(channels) < 1:
            raise ValueError(f"channels must be positive widths, at least one, got {list(channels)}")
        if kernel_size < 1 or kernel_size % 2 == 0:
            raise ValueError(f"kernel_size must be odd, got {kernel_size}")
        if first_stride < 1 or resolution % first_stride:
            raise ValueError(f"first_stride must divide the resolution {resolution}, got {first_stride}")
        self.convolutions = nn.ModuleList(
            nn.Conv2d(i, o, kernel_size, stride=first_stride if index == 0 else 1, padding=kernel_size // 2)
            for index, (i, o) in enumerate(zip([3, *channels[:-1]], channels, strict=True))
        )
        self.map_size = resolution // first_stride
        width = channels[-1]
        self.position = SoftPositionEmbedding(channels=width, height=self.map_size, width=self.map_size)
        self.mlp = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, token_dim), nn.ReLU(), nn.Linear(token_dim, token_dim)
        )

    def forward(self, images: Float[Tensor, "image 3 height width"]) -> Float[Tensor, "image token feature"]:
        """Encode images in [-1, 1]; tokens run over the rows of the feature map."""
        features = images
        for index, convolution in enumerate(self.convolutions):
            features = convolution(features if index == 0 else torch.relu(features))
        return self.mlp(self.position(features).flatten(2).transpose(1, 2))
