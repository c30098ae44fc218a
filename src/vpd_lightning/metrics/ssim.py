"""Structural similarity, one value per image."""

from jaxtyping import Float
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

_KERNEL_SIZE = 11
_SIGMA = 1.5
_BORDER = _KERNEL_SIZE // 2


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
    height, width = pred.shape[-3], pred.shape[-2]
    if min(height, width) < _KERNEL_SIZE:
        raise ValueError(f"SSIM needs images of at least {_KERNEL_SIZE}x{_KERNEL_SIZE} pixels, got {height}x{width}")
    leading = pred.shape[:-3]
    flat = [
        image.reshape(-1, height, width, 3).permute(0, 3, 1, 2).contiguous() for image in (pred.clamp(0.0, 1.0), target)
    ]
    if flat[0].shape[0] == 0:
        return pred.new_zeros(leading)
    _, similarity = structural_similarity_index_measure(
        flat[0], flat[1], gaussian_kernel=True, sigma=_SIGMA, kernel_size=_KERNEL_SIZE, data_range=1.0,
        reduction="none", return_full_image=True,
    )  # fmt: skip
    interior = similarity[..., _BORDER : height - _BORDER, _BORDER : width - _BORDER]
    return interior.mean((1, 2, 3)).reshape(leading)
