import math

import pytest
import torch

from vpd_lightning.renderer.rays.volumetric import composite, ray_weights


def intervals(num_rays: int, num_samples: int) -> tuple[torch.Tensor, torch.Tensor]:
    edges = torch.rand(num_rays, num_samples + 1, dtype=torch.float64).sort(dim=-1).values * 3
    return edges[:, :-1], edges[:, 1:]


def test_a_homogeneous_medium_matches_the_closed_form() -> None:
    sigma, color = 1.7, torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    edges = torch.linspace(0.5, 2.5, 33, dtype=torch.float64)[None]
    sigmas = torch.full((1, 32), sigma, dtype=torch.float64)
    rgb, weights, transmittance = composite(sigmas, color.expand(1, 32, 3), edges[:, :-1], edges[:, 1:])
    left = math.exp(-sigma * 2.0)
    assert float(transmittance) == pytest.approx(left, rel=1e-12)
    torch.testing.assert_close(rgb[0], color * (1 - left), rtol=1e-12, atol=0)
    starts = edges[0, :-1] - 0.5
    expected = torch.exp(-sigma * starts) - torch.exp(-sigma * (starts + 2.0 / 32))
    torch.testing.assert_close(weights[0], expected, rtol=1e-10, atol=0)


def test_weights_are_not_negative_and_sum_to_what_is_stopped() -> None:
    starts, ends = intervals(50, 40)
    sigmas = torch.rand(50, 40, dtype=torch.float64) * 10 ** torch.randn(50, 1, dtype=torch.float64)
    weights, transmittance = ray_weights(sigmas, starts, ends)
    assert bool((weights >= 0).all())
    torch.testing.assert_close(weights.sum(dim=-1), 1 - transmittance, rtol=0, atol=1e-12)


def test_empty_space_and_opaque_walls_are_exact() -> None:
    starts, ends = torch.arange(4.0)[None], torch.arange(1.0, 5.0)[None]
    rgbs = torch.rand(1, 4, 3)
    rgb, weights, transmittance = composite(torch.zeros(1, 4), rgbs, starts, ends)
    assert torch.equal(rgb, torch.zeros(1, 3)) and float(transmittance) == 1.0 and not bool(weights.any())
    rgb, weights, transmittance = composite(torch.tensor([[0.0, 1e6, 1e6, 0.0]]), rgbs, starts, ends)
    assert torch.equal(rgb[0], rgbs[0, 1]) and weights.tolist() == [[0, 1, 0, 0]] and float(transmittance) == 0.0


def test_splitting_an_interval_changes_nothing() -> None:
    starts, ends = intervals(5, 6)
    sigmas, rgbs = torch.rand(5, 6, dtype=torch.float64) * 3, torch.rand(5, 6, 3, dtype=torch.float64)
    middles = (starts + ends) / 2
    rgb, _, transmittance = composite(sigmas, rgbs, starts, ends)
    again, _, left = composite(
        sigmas.repeat_interleave(2, dim=-1),
        rgbs.repeat_interleave(2, dim=-2),
        torch.stack([starts, middles], dim=-1).flatten(1),
        torch.stack([middles, ends], dim=-1).flatten(1),
    )
    torch.testing.assert_close(again, rgb, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(left, transmittance, rtol=1e-12, atol=1e-12)


def test_tiny_densities_keep_their_digits_in_float32() -> None:
    sigmas = torch.logspace(-12, 0, 13)[None]
    ends = torch.ones(1, 13)
    for column in range(13):
        one = sigmas[:, column : column + 1]
        weights, _ = ray_weights(one, torch.zeros(1, 1), ends[:, :1])
        assert float(weights) == pytest.approx(-math.expm1(-float(one)), rel=1e-6)


def test_gradients_pass_finite_differences_and_stay_finite_at_the_extremes() -> None:
    starts, ends = intervals(2, 5)
    sigmas = torch.rand(2, 5, dtype=torch.float64, requires_grad=True)
    rgbs = torch.rand(2, 5, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda density, color: composite(density, color, starts, ends), (sigmas, rgbs))
    extreme = torch.tensor([[0.0, 1e-30, 1e6, 1e30, 0.0]], requires_grad=True)
    rgb, _, left = composite(extreme, torch.rand(1, 5, 3), torch.arange(5.0)[None], torch.arange(1.0, 6.0)[None])
    (rgb.sum() + left.sum()).backward()
    assert bool(torch.isfinite(extreme.grad).all()) and float(extreme.grad.abs().max()) < 10


def test_half_precision_is_composited_in_float32() -> None:
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rgb, weights, left = composite(
            torch.rand(2, 5).bfloat16(), torch.rand(2, 5, 3).bfloat16(), torch.zeros(2, 5), torch.ones(2, 5)
        )
    assert rgb.dtype == weights.dtype == left.dtype == torch.float32
