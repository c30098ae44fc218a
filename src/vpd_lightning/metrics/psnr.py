"""Peak signal-to-noise ratio, one value per image."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.metrics.true_images import TrueImages

PSNR_CAP = 100.0
"""An identical pair has infinite PSNR; averages over images count it as this many dB (see ``psnr_of_images``)."""


def mean_squared_error(
    pred: Float[Tensor, "*image height width 3"],
    target: Float[Tensor, "*image height width 3"],
    mask: Bool[Tensor, "*image height width"] | None = None,
) -> Float[Tensor, "*image"]:
    """Mean over pixels (those of ``mask``) and channels; NaN for an image whose mask is empty.

    The prediction is clamped to [0, 1] first, as a screen would.
    """
    squared = (pred.clamp(0.0, 1.0) - target).square().mean(-1)
    if mask is None:
        return squared.mean((-2, -1))
    return (squared * mask).sum((-2, -1)) / mask.sum((-2, -1))


def psnr_of(mse: Float[Tensor, "*image"]) -> Float[Tensor, "*image"]:
    """Convert a mean squared error of values in [0, 1] to decibels, ``-10 log10(mse)``; infinite where it is 0."""
    return -10.0 * torch.log10(mse)


def psnr(
    pred: Float[Tensor, "*image height width 3"], target: Float[Tensor, "*image height width 3"]
) -> Float[Tensor, "*image"]:
    """PSNR in dB of float images in [0, 1], one value per image; the prediction is clamped.

    Identical images have an infinite PSNR.
    """
    return psnr_of(mean_squared_error(pred, target))


def psnr_of_images(
    pred: Float[Tensor, "step_or_1 view height width 3"], truth: TrueImages
) -> dict[str, Float[Tensor, "step view"]]:
    """PSNR and mean squared error of every image; a prediction of one step stands for all steps.

    PSNR is cut at ``PSNR_CAP`` dB, so that one exact image (a scene at rest, copied) does not make a mean infinite.
    """
    mse = mean_squared_error(pred.expand_as(truth.colors), truth.colors)
    return {"psnr": psnr_of(mse).clamp(max=PSNR_CAP), "mse": mse}


def psnr_of_moving_pixels(
    pred: Float[Tensor, "step_or_1 view height width 3"], truth: TrueImages
) -> dict[str, Float[Tensor, "step view"]]:
    """The same over the moving pixels; NaN for an image with fewer than ``truth.min_moving_pixels`` of them."""
    assert truth.moving is not None
    mse = mean_squared_error(pred.expand_as(truth.colors), truth.colors, truth.moving)
    enough = truth.moving.sum((-2, -1)) >= truth.min_moving_pixels
    mse = torch.where(enough, mse, torch.full_like(mse, torch.nan))
    return {"psnr_moving": psnr_of(mse).clamp(max=PSNR_CAP), "moving_mse": mse}
