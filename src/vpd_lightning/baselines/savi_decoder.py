"""The spatial broadcast decoder of SAVi and SlotFormer (Watters et al. 2019): every slot paints its own layer."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.baselines.decoded_slots import DecodedSlots
from vpd_lightning.baselines.soft_position import SoftPositionEmbedding


class SAViDecoder(nn.Module):
    """Tiles a slot to ``start_resolution`` pixels, adds positions, and up-samples by transposed convolutions.

    ``channels`` starts with the width of a slot. The stride is 2 until ``resolution`` is reached, and 1 from there.
    """

    def __init__(self, *, resolution: int, channels: Sequence[int], kernel_size: int, start_resolution: int):
        super().__init__()
        if len(channels) < 2 or min(channels) < 1:
            raise ValueError(f"channels must be positive widths, at least two, got {list(channels)}")
        if kernel_size < 1 or kernel_size % 2 == 0:
            raise ValueError(f"kernel_size must be odd, got {kernel_size}")
        self.start_resolution = start_resolution
        self.position = SoftPositionEmbedding(channels=channels[0], height=start_resolution, width=start_resolution)
        self.convolutions = nn.ModuleList()
        size = start_resolution
        for i, o in zip(channels[:-1], channels[1:], strict=True):
            stride = 2 if size < resolution else 1
            self.convolutions.append(
                nn.ConvTranspose2d(
                    i, o, kernel_size, stride=stride, padding=kernel_size // 2, output_padding=stride - 1
                )
            )
            size *= stride
        if size != resolution:
            raise ValueError(
                f"{len(channels) - 1} layers take start_resolution {start_resolution} to {size} pixels, "
                f"not to resolution {resolution}; it must be start_resolution times a power of two"
            )
        self.to_layers = nn.Conv2d(channels[-1], 4, 1)

    def forward(self, slots: Float[Tensor, "*shape slot dim"]) -> DecodedSlots:
        """Decode sets of slots; softmax over the slots of a set mixes their colours."""
        size = self.start_resolution
        features = self.position(slots.flatten(0, -2)[..., None, None].expand(-1, -1, size, size))
        for convolution in self.convolutions:
            features = torch.relu(convolution(features))
        # The mixture stays in full precision, whatever autocast does to the convolutions.
        layers = self.to_layers(features).to(torch.promote_types(slots.dtype, torch.float32))
        layers = layers.unflatten(0, slots.shape[:-1])
        rgbs, masks = layers[..., :3, :, :], torch.softmax(layers[..., 3:, :, :], dim=-4)
        return DecodedSlots(images=(masks * rgbs).sum(dim=-4), rgbs=rgbs, masks=masks)
