"""PSNR and SSIM against scikit-image, masks, and edge cases."""

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from vpd_lightning.metrics.psnr import masked_psnr, mean_squared_error, psnr
from vpd_lightning.metrics.ssim import ssim


def image_pair(*shape: int, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(*shape, 3, generator=generator, dtype=dtype)
    noise = 0.2 * torch.randn(*shape, 3, generator=generator, dtype=dtype)
    return (target + noise).clamp(0, 1), target


def test_psnr_equals_scikit_image_per_image() -> None:
    pred, target = image_pair(2, 3, 20, 24)
    values = psnr(pred, target)
    assert values.shape == (2, 3)
    for index in np.ndindex(2, 3):
        reference = peak_signal_noise_ratio(target[index].numpy(), pred[index].numpy(), data_range=1.0)
        assert values[index].item() == pytest.approx(reference, abs=1e-9)


def test_psnr_clamps_the_prediction_as_a_screen_would() -> None:
    pred, target = image_pair(12, 12)
    wild = torch.where(pred > 0.9, torch.full_like(pred, 7.0), pred)
    assert psnr(wild, target) == psnr(wild.clamp(0, 1), target)


def test_psnr_of_identical_images_is_infinite() -> None:
    _, target = image_pair(12, 12)
    assert psnr(target, target).item() == float("inf")


def test_ssim_equals_scikit_image_per_image() -> None:
    pred, target = image_pair(2, 2, 24, 31)
    values = ssim(pred, target)
    assert values.shape == (2, 2)
    for index in np.ndindex(2, 2):
        reference = structural_similarity(
            target[index].numpy(), pred[index].numpy(), channel_axis=-1, data_range=1.0, gaussian_weights=True,
            sigma=1.5, use_sample_covariance=False,
        )  # fmt: skip
        assert values[index].item() == pytest.approx(reference, abs=1e-6)


def test_ssim_in_float32_agrees_with_float64() -> None:
    pred, target = image_pair(1, 24, 24)
    # The variance is a difference of two near squares, each accurate to 1e-7.
    torch.testing.assert_close(ssim(pred.float(), target.float()).double(), ssim(pred, target), atol=1e-4, rtol=0)


def test_ssim_refuses_images_smaller_than_its_window() -> None:
    with pytest.raises(ValueError, match="at least 11x11"):
        ssim(torch.zeros(10, 20, 3), torch.zeros(10, 20, 3))


def test_metrics_need_no_leading_axis() -> None:
    pred, target = image_pair(16, 16)
    assert psnr(pred, target).shape == ssim(pred, target).shape == ()


def test_masked_psnr_looks_at_the_mask_only() -> None:
    pred, target = image_pair(2, 16, 16)
    mask = torch.zeros(2, 16, 16, dtype=torch.bool)
    mask[:, :4, :5] = True
    spoiled = torch.where(mask.unsqueeze(-1), pred, 1.0 - pred)
    expected = psnr(pred[:, :4, :5], target[:, :4, :5])
    torch.testing.assert_close(masked_psnr(spoiled, target, mask, min_pixels=10), expected)


def test_masked_psnr_is_missing_where_too_few_pixels_move() -> None:
    pred, target = image_pair(2, 16, 16)
    mask = torch.zeros(2, 16, 16, dtype=torch.bool)
    mask[0, 0, :9] = True
    mask[1, 0, :10] = True
    assert masked_psnr(pred, target, mask, min_pixels=10).isnan().tolist() == [True, False]


def test_error_of_an_empty_mask_is_missing() -> None:
    pred, target = image_pair(16, 16)
    assert mean_squared_error(pred, target, torch.zeros(16, 16, dtype=torch.bool)).isnan()
