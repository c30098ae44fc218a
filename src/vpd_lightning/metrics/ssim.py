"""Structural similarity, one value per image."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.metrics.true_images import TrueImages

KERNEL_SIZE = 11
_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2  # of values in [0, 1]


@dataclass(frozen=True)
class LocalMoments:
    """What SSIM needs of images: their values, and mean and variance in the Gaussian window of each pixel.

    ``centred`` are the values less ``center``, the mean of the channel: squares of small numbers lose fewer digits when
    one is taken from the other, and variances stay the same.
    """

    centred: Float[Tensor, "*image 3 height width"]
    center: Float[Tensor, "*image 3 1 1"]
    mean: Float[Tensor, "*image 3 inner_height inner_width"]
    variance: Float[Tensor, "*image 3 inner_height inner_width"]


def local_moments(images: Float[Tensor, "*image height width 3"]) -> LocalMoments:
    """Compute the local moments of images in [0, 1], for ``ssim_of``; those of one image serve several comparisons.

    Raises:
        ValueError: the images are smaller than the window.
    """
    height, width = images.shape[-3], images.shape[-2]
    if min(height, width) < KERNEL_SIZE:
        raise ValueError(f"SSIM needs images of at least {KERNEL_SIZE}x{KERNEL_SIZE} pixels, got {height}x{width}")
    planes = images.movedim(-1, -3).contiguous()
    center = planes.mean((-2, -1), keepdim=True)
    centred = planes - center
    mean = _blurred(centred)
    return LocalMoments(centred, center, mean, _blurred(centred.square()) - mean.square())


def ssim_of(pred: LocalMoments, target: LocalMoments) -> Float[Tensor, "..."]:
    """SSIM of images whose moments are known; their leading axes may broadcast (see ``ssim``)."""
    covariance = _blurred(pred.centred * target.centred) - pred.mean * target.mean
    mean, target_mean = pred.mean + pred.center, target.mean + target.center
    luminance = (2 * mean * target_mean + _C1) / (mean.square() + target_mean.square() + _C1)
    structure = (2 * covariance + _C2) / (pred.variance + target.variance + _C2)
    return (luminance * structure).mean((-3, -2, -1))


def ssim(
    pred: Float[Tensor, "*image height width 3"], target: Float[Tensor, "*image height width 3"]
) -> Float[Tensor, "*image"]:
    """SSIM (Wang et al. 2004) of float images in [0, 1], one value per image; the prediction is clamped.

    11x11 Gaussian window of standard deviation 1.5, data range 1, population covariance, averaged over the channels
    and over the interior where the window fits (the map without its 5-pixel border). That is what scikit-image gives
    with ``gaussian_weights=True, sigma=1.5, use_sample_covariance=False``.

    Raises:
        ValueError: the images are smaller than the window.
    """
    return ssim_of(local_moments(pred.clamp(0.0, 1.0)), local_moments(target))


def ssim_of_images(
    pred: Float[Tensor, "step_or_1 view height width 3"], truth: TrueImages
) -> Float[Tensor, "step view"]:
    """SSIM of every image; NaN where images are smaller than the window."""
    if min(truth.colors.shape[-3:-1]) < KERNEL_SIZE:
        return truth.colors.new_full(truth.colors.shape[:2], torch.nan)
    return ssim_of(local_moments(pred.clamp(0.0, 1.0)), truth.once(local_moments))


def _blurred(maps: Float[Tensor, "*map height width"]) -> Float[Tensor, "*map inner_height inner_width"]:
    """Weigh the window around every pixel that it fits around.

    The window is a product of one along each side, and each is a product with a band matrix: on a CPU that takes a
    tenth of the time of a convolution.
    """
    height, width = maps.shape[-2:]
    rows = (maps.reshape(-1, width) @ _band(width, maps)).reshape(*maps.shape[:-1], -1)
    return _band(height, maps).T @ rows


def _band(size: int, like: Tensor) -> Float[Tensor, "size inner_size"]:
    offset = torch.arange(KERNEL_SIZE, dtype=torch.float64) - KERNEL_SIZE // 2
    window = torch.exp(-0.5 * (offset / _SIGMA).square())
    window = (window / window.sum()).to(like)
    band = like.new_zeros(size, size - KERNEL_SIZE + 1)
    inner = torch.arange(size - KERNEL_SIZE + 1, device=like.device)
    for number, weight in enumerate(window):
        band[inner + number, inner] = weight
    return band
