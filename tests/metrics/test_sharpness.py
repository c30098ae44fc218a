"""Sharpness: a ratio that a blur lowers."""

import cv2
import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from vpd_lightning.metrics.sharpness import gradient_magnitude, sharpness


def textured(*shape: int) -> torch.Tensor:
    noise = np.random.default_rng(0).random((*shape, 3))
    return torch.from_numpy(gaussian_filter(noise, [0] * (len(shape) - 2) + [1, 1, 0]))


def test_an_image_is_as_sharp_as_itself() -> None:
    images = textured(2, 24, 32)
    assert sharpness(images, images).tolist() == [1.0, 1.0]


def test_more_blur_is_less_sharp() -> None:
    truth = textured(40, 40)
    values = [sharpness(torch.from_numpy(gaussian_filter(truth, [s, s, 0])), truth).item() for s in (0.5, 1, 2, 4)]
    assert values == sorted(values, reverse=True) and values[0] < 1 and values[-1] < 0.2


def test_halved_contrast_is_half_as_sharp_and_noise_is_sharper() -> None:
    truth = textured(40, 40)
    assert sharpness(0.5 * truth + 0.2, truth).item() == pytest.approx(0.5, rel=1e-6)
    noise = 0.1 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0), dtype=truth.dtype)
    assert sharpness(truth + noise, truth).item() > 1.2


def test_enlarging_a_smaller_image_costs_sharpness() -> None:
    truth = textured(32, 32)
    small = cv2.resize(cv2.resize(truth.numpy(), (16, 16)), (32, 32))
    assert sharpness(torch.from_numpy(small), truth).item() < 0.9


def test_images_of_one_colour_are_defined() -> None:
    flat, busy = torch.full((16, 16, 3), 0.3), textured(16, 16).float()
    assert sharpness(flat, 2 * flat).item() == 1.0
    assert sharpness(flat, busy).item() == pytest.approx(0.0, abs=1e-5)
    assert sharpness(busy, flat).isnan()


def test_one_image_does_not_decide_a_mean() -> None:
    hint = torch.full((16, 16, 3), 0.5)
    hint[:, 8:] += 0.03  # the truth hardly has structure
    assert gradient_magnitude(hint).item() > 1e-3
    assert sharpness(textured(16, 16).float() * 3 - 1, hint).item() == 10.0
    hint[:, 8:] = 0.51
    assert sharpness(textured(16, 16).float(), hint).isnan()


def test_gradient_of_a_ramp_is_its_slope_and_the_prediction_is_clamped() -> None:
    ramp = (0.02 * torch.arange(16.0) + 0.01 * torch.arange(16.0)[:, None])[..., None].expand(-1, -1, 3)
    assert gradient_magnitude(ramp).item() == pytest.approx(0.0005**0.5, rel=1e-5)
    assert sharpness(100 * ramp + 2, ramp).item() == 0.0


def test_one_prediction_stands_for_several_truths() -> None:
    truths = textured(3, 2, 16, 16)
    torch.testing.assert_close(sharpness(truths[:1], truths), sharpness(truths[:1].expand_as(truths), truths))
