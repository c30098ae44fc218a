"""Resizing of images by one pinned filter, for training data and for evaluation alike."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


def resize_images(
    images: Float[Tensor, "*shape height width 3"] | UInt8[Tensor, "*shape height width 3"],
    size: int | tuple[int, int],
) -> Tensor:
    """Return images of ``size`` pixels (one number for both sides, or height and width), ``*shape height width 3``.

    Bilinear without antialiasing, which is SlotFormer's filter; to half the size it is the mean of 2x2 pixels. uint8
    stays uint8, rounded, so that training, stored slots and evaluation see the same bytes; float stays as it is.
    """
    height, width = (size, size) if isinstance(size, int) else size
    if height < 1 or width < 1:
        raise ValueError(f"size must be at least 1 pixel, got {height}x{width}")
    if images.shape[-3:-1] == (height, width):
        return images
    planes = images.reshape(-1, *images.shape[-3:]).movedim(-1, 1)
    floats = planes if planes.is_floating_point() else planes.float()
    resized = torch.nn.functional.interpolate(
        floats, size=(height, width), mode="bilinear", align_corners=False, antialias=False
    )
    if not images.is_floating_point():
        resized = resized.round().clamp(0, 255).to(images.dtype)
    return resized.movedim(1, -1).reshape(*images.shape[:-3], height, width, 3)
