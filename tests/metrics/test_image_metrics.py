"""PSNR and SSIM against scikit-image, masks, and edge cases."""

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from vpd_lightning.metrics.psnr import PSNR_CAP, mean_squared_error, psnr, psnr_of_images, psnr_of_moving_pixels
from vpd_lightning.metrics.ssim import ssim
from vpd_lightning.metrics.true_images import TrueImages


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


def photographs(size: int) -> dict[str, torch.Tensor]:
    """Images of several kinds: noise, smooth, nearly flat and bright, half black and half white."""
    generator = torch.Generator().manual_seed(size)
    noise = torch.rand(size, size, 3, generator=generator)
    row, column = torch.meshgrid(torch.linspace(0, 1, size), torch.linspace(0, 1, size), indexing="ij")
    flat = torch.full((size, size, 3), 0.93)
    flat[size // 4 : size // 3, size // 4 : size // 2] = 0.2
    return {
        "noise": noise,
        "smooth": torch.stack([row, column, 0.5 + 0.5 * torch.sin(9 * row * column)], -1),
        "flat": flat,
        "halves": (column > 0.5).float()[..., None].expand(-1, -1, 3).contiguous(),
    }


@pytest.mark.parametrize("size", [64, 128])
@pytest.mark.parametrize("kind", ["noise", "smooth", "flat", "halves"])
def test_float32_metrics_equal_scikit_image_in_float64(size: int, kind: str) -> None:
    target = photographs(size)[kind]
    blur = 0.7 * target + 0.3 * target.roll(1, 0)
    pred = (blur + 0.02 * torch.randn(target.shape, generator=torch.Generator().manual_seed(1))).clamp(0, 1)
    pair = target.double().numpy(), pred.double().numpy()
    expected = structural_similarity(
        *pair, channel_axis=-1, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    assert ssim(pred, target).item() == pytest.approx(expected, abs=1e-5)
    assert psnr(pred, target).item() == pytest.approx(peak_signal_noise_ratio(*pair, data_range=1.0), abs=1e-5)


def test_ssim_is_symmetric_and_one_for_the_same_image() -> None:
    pred, target = image_pair(3, 24, 24, dtype=torch.float32)
    torch.testing.assert_close(ssim(pred, target), ssim(target, pred))
    torch.testing.assert_close(ssim(target, target), torch.ones(3))


def test_a_constant_error_of_a_tenth_is_20_decibels_whatever_the_batch() -> None:
    target = 0.8 * torch.rand(16, 12, 12, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(psnr(target + 0.1, target), torch.full((16,), 20.0), atol=1e-4, rtol=0)
    pred = (target + 0.1 * torch.rand(16, 1, 1, 1)).clamp(0, 1)
    whole, parts = psnr(pred, target), [torch.cat([psnr(*pair) for pair in batches(pred, target, n)]) for n in (1, 3)]
    assert all(torch.equal(part, whole) for part in parts), "one number per image, and no image knows of another"
    whole, parts = ssim(pred, target), [torch.cat([ssim(*pair) for pair in batches(pred, target, n)]) for n in (1, 3)]
    for part in parts:
        torch.testing.assert_close(part, whole, atol=1e-6, rtol=0)


def batches(pred: torch.Tensor, target: torch.Tensor, size: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    return list(zip(pred.split(size), target.split(size), strict=True))


def test_ssim_refuses_images_smaller_than_its_window() -> None:
    with pytest.raises(ValueError, match="at least 11x11"):
        ssim(torch.zeros(10, 20, 3), torch.zeros(10, 20, 3))


def test_metrics_need_no_leading_axis() -> None:
    pred, target = image_pair(16, 16)
    assert psnr(pred, target).shape == ssim(pred, target).shape == ()


def test_psnr_of_moving_pixels_looks_at_them_only() -> None:
    pred, target = image_pair(1, 2, 16, 16)
    mask = torch.zeros(1, 2, 16, 16, dtype=torch.bool)
    mask[..., :4, :5] = True
    spoiled = torch.where(mask.unsqueeze(-1), pred, 1.0 - pred)
    found = psnr_of_moving_pixels(spoiled, TrueImages(target, mask, min_moving_pixels=10))
    torch.testing.assert_close(found["psnr_moving"], psnr(pred[..., :4, :5, :], target[..., :4, :5, :]))


def test_psnr_of_moving_pixels_is_missing_where_too_few_move() -> None:
    pred, target = image_pair(1, 2, 16, 16)
    mask = torch.zeros(1, 2, 16, 16, dtype=torch.bool)
    mask[0, 0, 0, :9] = True
    mask[0, 1, 0, :10] = True
    found = psnr_of_moving_pixels(pred, TrueImages(target, mask, min_moving_pixels=10))
    assert all(values.isnan().tolist() == [[True, False]] for values in found.values())


def test_an_exact_image_counts_as_the_cap_and_one_prediction_stands_for_all_steps() -> None:
    pred, target = image_pair(3, 2, 16, 16)
    pred[0] = target[2]
    found = psnr_of_images(pred[:1], TrueImages(target))
    assert found["psnr"].shape == (3, 2) and found["psnr"][2].tolist() == [PSNR_CAP, PSNR_CAP]
    torch.testing.assert_close(found["psnr"][:2], psnr(target[2].expand(2, -1, -1, -1, -1), target[:2]))


def test_error_of_an_empty_mask_is_missing() -> None:
    pred, target = image_pair(16, 16)
    assert mean_squared_error(pred, target, torch.zeros(16, 16, dtype=torch.bool)).isnan()
