"""FLIP against its formula for plain colours, the package called by hand, and what it must not depend on."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from skimage.color import rgb2lab

from vpd_lightning.metrics.flip import flip, flip_of_images, is_installed
from vpd_lightning.metrics.true_images import TrueImages

needs_package = pytest.mark.skipif(not is_installed(), reason="flip-evaluator has no wheel for this machine")
COLORS = {"black": (0, 0, 0), "white": (1, 1, 1), "red": (1, 0, 0), "blue": (0, 0, 1), "olive": (0.5, 0.45, 0.1)}


def textured(*shape: int) -> torch.Tensor:
    noise = np.random.default_rng(0).random((*shape, 3))
    smooth = gaussian_filter(noise, [0] * (len(shape) - 2) + [1.5, 1.5, 0])
    return torch.from_numpy((smooth - smooth.min()) / (smooth.max() - smooth.min())).float()


def plain(color: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(color, dtype=torch.float32).expand(12, 15, 3)


def by_formula(first: tuple[float, ...], second: tuple[float, ...]) -> float:
    """Section 4.1 of the paper, for images of one colour: nothing to blur, and no edges."""

    def hunt(color: tuple[float, ...]) -> np.ndarray:
        lightness, a, b = rgb2lab(np.array(color, dtype=float))
        return np.array([lightness, 0.01 * lightness * a, 0.01 * lightness * b])

    def distance(one: np.ndarray, other: np.ndarray) -> float:
        return float((abs(one[0] - other[0]) + np.hypot(*(one - other)[1:])) ** 0.7)

    most = distance(hunt((0, 1, 0)), hunt((0, 0, 1)))
    error, knee = distance(hunt(first), hunt(second)), 0.4 * most
    return 0.95 * error / knee if error < knee else 0.95 + 0.05 * (error - knee) / (most - knee)


@needs_package
@pytest.mark.parametrize(
    ("first", "second"), [("black", "white"), ("red", "blue"), ("olive", "white"), ("olive", "red"), ("blue", "black")]
)
def test_plain_colours_follow_the_formula(first: str, second: str) -> None:
    value = flip(plain(COLORS[first]), plain(COLORS[second])).item()
    assert value == pytest.approx(by_formula(COLORS[first], COLORS[second]), abs=2e-3)


@needs_package
def test_black_on_white_and_identical_images() -> None:
    images = textured(2, 20, 24)
    assert flip(images, images).tolist() == [0.0, 0.0]
    assert flip(plain((0, 0, 0)), plain((1, 1, 1))).item() == pytest.approx(0.9673, abs=1e-3)


@needs_package
def test_it_is_what_the_package_says_of_each_image_with_its_defaults() -> None:
    from flip_evaluator import evaluate as by_hand

    truth = textured(2, 3, 18, 25)
    pred = (truth + 0.2 * torch.roll(truth, 4, dims=3) - 0.1).clamp(0, 1)
    values = flip(pred, truth)
    assert values.shape == (2, 3) and values.dtype == truth.dtype
    for index in np.ndindex(2, 3):
        expected = by_hand(truth[index].numpy(), pred[index].numpy(), "LDR")[1]
        assert values[index].item() == pytest.approx(expected, rel=1e-5)


@needs_package
def test_channels_are_red_green_blue() -> None:
    from flip_evaluator import evaluate as by_hand

    truth = textured(24, 24) * torch.tensor([0.9, 0.3, 0.2])
    redder, bluer = truth + torch.tensor([0.1, 0.0, 0.0]), truth + torch.tensor([0.0, 0.0, 0.1])
    for pred in (redder, bluer):
        expected = by_hand(truth.numpy(), pred.numpy(), "LDR")[1]
        swapped = by_hand(truth.flip(-1).numpy().copy(), pred.flip(-1).numpy().copy(), "LDR")[1]
        assert flip(pred, truth).item() == pytest.approx(expected, rel=1e-5) != pytest.approx(swapped, rel=0.05)
    assert flip(redder, truth).item() != pytest.approx(flip(bluer, truth).item(), rel=0.05)


@needs_package
def test_more_blur_more_noise_and_a_larger_shift_are_worse() -> None:
    truth = textured(40, 40)
    noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))
    blurred = [flip(torch.from_numpy(gaussian_filter(truth, [s, s, 0])), truth).item() for s in (0.5, 1, 2, 4)]
    noisy = [flip(truth + amount * noise, truth).item() for amount in (0.01, 0.03, 0.1, 0.3)]
    brighter = [flip(truth + amount, truth).item() for amount in (0.01, 0.05, 0.1, 0.2)]
    for values in (blurred, noisy, brighter):
        assert values == sorted(values) and 0 < values[0] < 0.5 * values[-1] < 0.5


@needs_package
def test_it_does_not_matter_which_image_is_the_truth() -> None:
    first, second = textured(2, 20, 20)
    assert flip(first, second).item() == pytest.approx(flip(second, first).item(), rel=1e-6)


@needs_package
def test_the_prediction_is_clamped_and_nothing_is_written_to() -> None:
    truth = textured(16, 16)
    wild = 3 * truth - 1
    before = truth.clone(), wild.clone()
    assert flip(wild, truth) == flip(wild.clamp(0, 1), truth)
    assert torch.equal(truth, before[0]) and torch.equal(wild, before[1])


@needs_package
def test_threads_do_not_change_it_and_stay_as_many() -> None:
    truth = textured(2, 32, 32)
    before, values = torch.get_num_threads(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            values.append(flip(truth.roll(3, 1), truth))
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*values)


@needs_package
def test_one_prediction_stands_for_all_steps() -> None:
    truth = textured(3, 2, 12, 14)
    values = flip_of_images(truth[:1], TrueImages(truth))
    assert values.shape == (3, 2) and values[0].tolist() == [0.0, 0.0] and (values[1:] > 0).all()
    torch.testing.assert_close(values, flip(truth[:1].expand_as(truth), truth))
