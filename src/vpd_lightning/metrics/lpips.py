"""LPIPS: how far apart two images are in the features of a trained network (Zhang et al. 2018), one value per image."""

from functools import cache
from pathlib import Path
from urllib.parse import urlparse

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.metrics.true_images import TrueImages

_IMAGES_PER_CALL = 64
"""At 128 x 128 pixels the features of as many take about 100 MB."""

_SMALLEST = 31
"""Pixels on a side; AlexNet has no features of smaller images."""


@cache
def network() -> nn.Module | None:
    """Return torchmetrics' LPIPS over AlexNet, or None where torchvision or its weights are not on this machine.

    Nothing is downloaded: docs/reproducing.md says how to get the weights.
    """
    try:
        from torchvision.models import AlexNet_Weights
    except (ImportError, RuntimeError, AttributeError):  # one built for another PyTorch fails while it is imported
        return None
    file = Path(urlparse(AlexNet_Weights.DEFAULT.url).path).name
    if not (Path(torch.hub.get_dir()) / "checkpoints" / file).is_file():
        return None
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    return LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True).net


@torch.no_grad()
def lpips(
    pred: Float[Tensor, "*image height width 3"], target: Float[Tensor, "*image height width 3"], features: nn.Module
) -> Float[Tensor, "*image"]:
    """LPIPS of sRGB images in [0, 1] by a network of torchmetrics; 0 for identical ones, the prediction is clamped."""
    size = target.shape[-3:]
    tests, references = (
        images.detach().reshape(-1, *size).float().movedim(-1, 1) for images in (pred.clamp(0, 1), target)
    )
    pairs = zip(tests.split(_IMAGES_PER_CALL), references.split(_IMAGES_PER_CALL), strict=True)
    values = [features.to(target.device)(test, reference, normalize=True).flatten() for test, reference in pairs]
    return torch.cat(values).to(target.dtype).reshape(target.shape[:-3])


def lpips_of_images(
    pred: Float[Tensor, "step_or_1 view height width 3"], truth: TrueImages
) -> Float[Tensor, "step view"]:
    """LPIPS of every image; NaN where there is no network for it, or images are too small for it."""
    found = network()
    if found is None or min(truth.colors.shape[2:4]) < _SMALLEST:
        return truth.colors.new_full(truth.colors.shape[:2], torch.nan)
    return lpips(pred.expand_as(truth.colors), truth.colors, found)
