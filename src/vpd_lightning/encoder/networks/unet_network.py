"""The UNet that turns an RGB image into per-pixel features (paper appendix A, Ronneberger et al. 2015)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


class UNetNetwork(nn.Module):
    """One 3x3 convolution per listed width, ReLU between, no normalisation; the last output is left linear.

    ``channels`` lists an odd number of widths, fine to coarse to fine. The first (n+1)/2 descend with a 2x2 max-pool
    between them; the rest ascend by nearest up-sampling and concatenation of the skip of the same size. With nine
    widths: 5 resolutions down, 4 up.
    """

    # Paper: gives the widths only; one convolution per width and the pooling are our reading (docs/architecture.md).

    def __init__(self, *, channels: Sequence[int], in_channels: int):
        super().__init__()
        if len(channels) % 2 == 0 or len(channels) < 3 or min(channels) < 1:
            raise ValueError(f"channels must be an odd number (>= 3) of positive widths, got {list(channels)}")
        num_levels = (len(channels) + 1) // 2
        down = list(channels[:num_levels])
        self.down = nn.ModuleList(
            nn.Conv2d(i, o, 3, padding=1) for i, o in zip([in_channels, *down[:-1]], down, strict=True)
        )
        self.up = nn.ModuleList()
        width = down[-1]
        for skip, out in zip(reversed(down[:-1]), channels[num_levels:], strict=True):
            self.up.append(nn.Conv2d(width + skip, out, 3, padding=1))
            width = out
        self.size_divisor = 2 ** (num_levels - 1)

    def forward(self, images: Float[Tensor, "image channel height width"]) -> Float[Tensor, "image feature h w"]:
        """Return the per-pixel output; height and width must divide by 2^(levels - 1)."""
        x, skip = self._all_but_last(images)
        return self.up[-1](torch.cat([_upsample(x), skip], dim=1))

    def at_pixels(
        self, images: Float[Tensor, "image channel height width"], pixels: Int[Tensor, " particle"]
    ) -> Float[Tensor, "particle feature"]:
        """Return the output at the chosen pixels (flat index over image, row, column): equal to ``forward`` there.

        The last convolution is the most expensive one. Where few pixels become particles it pays to evaluate it only
        there, from gathered 3x3 patches; its input is never up-sampled.
        """
        x, skip = self._all_but_last(images)
        height, width = skip.shape[-2:]
        steps = torch.arange(-1, 2, device=pixels.device)
        image = (pixels // (height * width))[:, None, None]
        rows = (pixels // width % height)[:, None, None] + steps[:, None]
        columns = (pixels % width)[:, None, None] + steps
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        rows, columns = rows.clamp(0, height - 1), columns.clamp(0, width - 1)

        def gather(values: Tensor, scale: int) -> Tensor:
            flat = (image * (height // scale) + rows // scale) * (width // scale) + columns // scale
            return values.movedim(1, -1).flatten(0, 2).index_select(0, flat.flatten())

        last = self.up[-1]
        assert isinstance(last, nn.Conv2d) and last.bias is not None
        patches = torch.cat([gather(x, 2), gather(skip, 1)], dim=-1) * inside.flatten()[:, None]
        weight = last.weight.permute(2, 3, 1, 0).flatten(0, 2)  # row, column, input channel -> output channel
        return patches.reshape(len(pixels), -1) @ weight.to(patches.dtype) + last.bias.to(patches.dtype)

    def _all_but_last(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return what the last up-step starts from: the half-size map and the skip of full size."""
        height, width = images.shape[-2:]
        if height % self.size_divisor or width % self.size_divisor:
            raise ValueError(f"image size {height}x{width} must be a multiple of {self.size_divisor}; resize or pad it")
        x, skips = images, []
        for level, conv in enumerate(self.down):
            if level > 0:
                x = nn.functional.max_pool2d(x, 2)
            x = torch.relu(conv(x))
            skips.append(x)
        skips.pop()
        for conv in list(self.up)[:-1]:
            x = torch.relu(conv(torch.cat([_upsample(x), skips.pop()], dim=1)))
        return x, skips.pop()


def _upsample(x: Tensor) -> Tensor:
    return nn.functional.interpolate(x, scale_factor=2, mode="nearest")
