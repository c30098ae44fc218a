"""How sharp a predicted image is beside the truth: averages over pixels forgive a blur, eyes do not."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.metrics.true_images import TrueImages

_LUMINANCE = (0.299, 0.587, 0.114)  # ITU-R BT.601
_FLAT = 1e-3  # of 1; an image with less than this mean gradient has no structure (one 8-bit step is 4e-3)
_MOST = 10.0  # one image must not decide a mean


def gradient_magnitude(images: Float[Tensor, "*image height width 3"]) -> Float[Tensor, "*image"]:
    """Mean length of the luminance's gradient, per pixel: differences to the next pixel to the right and below."""
    luminance = images @ images.new_tensor(_LUMINANCE)
    right = luminance[..., :-1, 1:] - luminance[..., :-1, :-1]
    below = luminance[..., 1:, :-1] - luminance[..., :-1, :-1]
    return torch.hypot(right, below).mean((-2, -1))


def sharpness(
    pred: Float[Tensor, "*#image height width 3"], target: Float[Tensor, "*#image height width 3"]
) -> Float[Tensor, "..."]:
    """Mean gradient magnitude of each prediction (clamped to [0, 1]) over that of its truth: below 1 is blurred.

    Bounded to 10. Noise and wrong edges raise it, so it means nothing without an error beside it; where most of a
    picture does not move, the background dominates it. Two images of one colour are equally
    sharp (1); a truth of one colour is no measure for a prediction that has structure (NaN).
    """
    blurred, sharp = gradient_magnitude(pred.clamp(0.0, 1.0)), gradient_magnitude(target)
    both_flat = torch.where(blurred < _FLAT, torch.ones_like(sharp), torch.full_like(sharp, torch.nan))
    return torch.where(sharp < _FLAT, both_flat, (blurred / sharp.clamp(min=_FLAT)).clamp(max=_MOST))


def sharpness_of_images(
    pred: Float[Tensor, "step_or_1 view height width 3"], truth: TrueImages
) -> Float[Tensor, "step view"]:
    """Return the sharpness of every image (see ``sharpness``)."""
    return sharpness(pred, truth.colors)
