"""The position embedding of slot attention (Locatello et al. 2020): where a pixel lies, in four linear channels."""

import torch
from jaxtyping import Float
from torch import Tensor, nn


class SoftPositionEmbedding(nn.Module):
    """Adds a learned linear map of (y, x, 1-y, 1-x) to a feature map; each runs from 0 to 1, both ends included."""

    def __init__(self, *, channels: int, height: int, width: int):
        super().__init__()
        rows, columns = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
        grid = torch.stack([rows, columns, 1 - rows, 1 - columns], dim=-1)
        self.register_buffer("grid", grid, persistent=False)
        self.linear = nn.Linear(4, channels)

    def forward(self, features: Float[Tensor, "image channel height width"]) -> Tensor:
        """Return ``features`` plus the embedding of every pixel."""
        return features + self.linear(self.grid).movedim(-1, 0)
