"""The convolutional part of a residual network, without pooling and classifier (He et al. 2016, ResNet-18)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn


class ResNetTrunk(nn.Module):
    """Images to feature maps of 1/32 of their size (rounded up).

    A 7x7 convolution of stride 2, a 3x3 max-pool of stride 2, then one stage per entry of ``widths`` with as many basic
    blocks as ``blocks`` gives; the first block of each stage but the first has stride 2. ResNet-18 has widths 64, 128,
    256, 512 and two blocks each: 11,176,512 parameters.

    ``num_groups`` is that of group normalisation (Wu and He 2018); ``None`` takes batch normalisation, which needs
    large batches on each device and differs between training and evaluation.
    """

    def __init__(self, *, in_channels: int, widths: Sequence[int], blocks: Sequence[int], num_groups: int | None):
        super().__init__()
        if len(widths) != len(blocks) or not widths or min(*widths, *blocks) < 1:
            raise ValueError(
                f"widths and blocks must hold as many numbers of at least 1, got {list(widths)}, {list(blocks)}"
            )
        if num_groups is not None and (num_groups < 1 or any(width % num_groups for width in widths)):
            raise ValueError(f"num_groups must divide every width of {list(widths)}, or be null; got {num_groups}")
        self.stem = nn.Sequential(
            nn.Conv2d(in_channels, widths[0], 7, stride=2, padding=3, bias=False),
            _normalization(widths[0], num_groups),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(3, stride=2, padding=1),
        )
        self.stages = nn.ModuleList()
        before = widths[0]
        for stage, (width, count) in enumerate(zip(widths, blocks, strict=True)):
            strides = [1 if stage == 0 else 2] + [1] * (count - 1)
            inputs = [before] + [width] * (count - 1)
            layers = [_BasicBlock(i, width, s, num_groups) for i, s in zip(inputs, strides, strict=True)]
            self.stages.append(nn.Sequential(*layers))
            before = width
        self.out_channels = widths[-1]
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def map_size(self, height: int, width: int) -> tuple[int, int]:
        """Return height and width of the map of an image."""
        for _ in range(len(self.stages) + 1):
            height, width = (height + 1) // 2, (width + 1) // 2
        return height, width

    def forward(self, images: Float[Tensor, "image channel height width"]) -> Float[Tensor, "image feature h w"]:
        """Return the feature maps."""
        x = self.stem(images)
        for stage in self.stages:
            x = stage(x)
        return x


class _BasicBlock(nn.Module):
    """Two 3x3 convolutions around a shortcut, which is a 1x1 convolution where the shape changes."""

    def __init__(self, in_channels: int, width: int, stride: int, num_groups: int | None):
        super().__init__()
        self.first = nn.Conv2d(in_channels, width, 3, stride=stride, padding=1, bias=False)
        self.first_normalization = _normalization(width, num_groups)
        self.second = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.second_normalization = _normalization(width, num_groups)
        self.shortcut = None
        if stride != 1 or in_channels != width:
            projection = nn.Conv2d(in_channels, width, 1, stride=stride, bias=False)
            self.shortcut = nn.Sequential(projection, _normalization(width, num_groups))

    def forward(self, x: Tensor) -> Tensor:
        hidden = torch.relu(self.first_normalization(self.first(x)))
        hidden = self.second_normalization(self.second(hidden))
        return torch.relu(hidden + (x if self.shortcut is None else self.shortcut(x)))


def _normalization(width: int, num_groups: int | None) -> nn.Module:
    return nn.BatchNorm2d(width) if num_groups is None else nn.GroupNorm(num_groups, width)
