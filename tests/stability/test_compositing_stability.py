"""Volume rendering and sampling along rays, from nothing at all to walls of density 1e6 per interval."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.stability.hard_scenes import Mode, is_finite
from vpd_lightning.geometry.ray_sampling import even_quantiles, sample_pdf, stratified_samples
from vpd_lightning.renderer.rays.volumetric import composite

NUM_SAMPLES = 384  # the paper's ray
DEPTHS = (0.0, 1e-45, 1e-30, 1e-12, 1e-7, 1e-3, 1.0, 30.0, 88.0, 110.0, 1e3, 1e6)


def _only(*samples: int) -> Callable[[float], Tensor]:
    def depths(depth: float) -> Tensor:
        values = torch.zeros(NUM_SAMPLES, dtype=torch.float64)
        values[list(samples)] = depth
        return values

    return depths


# Optical depth (sigma times delta) of each interval of one ray.
RAYS: dict[str, Callable[[float], Tensor]] = {
    "fog": lambda depth: torch.full((NUM_SAMPLES,), depth, dtype=torch.float64),
    "wall_first": _only(0),
    "wall_in_the_middle": _only(200),
    "wall_last": _only(-1),
    "two_walls": _only(100, 300),
    "stripes": lambda depth: depth * (torch.arange(NUM_SAMPLES) % 2).double(),
    "thickening": lambda depth: depth * torch.linspace(0, 1, NUM_SAMPLES, dtype=torch.float64),
}


def along(delta: float, num_samples: int = NUM_SAMPLES) -> tuple[Tensor, Tensor]:
    edges = 0.3 + delta * torch.arange(num_samples + 1, dtype=torch.float64)
    return edges[:-1], edges[1:]


def closed_form(optical_depth: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return weights and transmittance as products in extended precision: no cumulated sum, no expm1."""
    passed = np.exp(-optical_depth.numpy().astype(np.longdouble))
    reached = np.concatenate([[np.longdouble(1)], np.cumprod(passed)])
    return (reached[:-1] * -np.expm1(-optical_depth.numpy().astype(np.longdouble))), reached[-1]


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("ray", RAYS)
def test_light_is_stopped_as_in_extended_precision(ray: str, depth: float, mode: Mode, device: torch.device):
    starts, ends = (edges[None].to(device, mode.dtype) for edges in along(2.0**-7))  # exact in float32
    sigmas = (RAYS[ray](depth)[None] / 2.0**-7).to(device, mode.dtype).requires_grad_()
    rgbs = torch.rand(1, NUM_SAMPLES, 3, generator=torch.Generator().manual_seed(0)).to(device, mode.dtype)
    rgbs.requires_grad_()

    with mode.context(device):
        rgb, weights, transmittance = composite(sigmas, rgbs, starts, ends)
    gradients = torch.autograd.grad(rgb.sum() + (weights * starts).sum() + transmittance.sum(), [sigmas, rgbs])

    assert rgb.dtype == mode.dtype and is_finite(rgb, weights, transmittance, *gradients)
    assert (weights >= 0).all() and (transmittance >= 0).all() and (transmittance <= 1).all()
    # The sum of 384 weights is rounded 384 times.
    torch.testing.assert_close(
        weights.sum(-1) + transmittance, torch.ones_like(transmittance), rtol=0, atol=400 * mode.eps
    )
    exact_depth = (sigmas.detach().double() * (ends - starts).double())[0].cpu()
    exact_weights, exact_left = closed_form(exact_depth)
    # exp(-x) errs by eps x exp(-x) <= eps / e for the rounding of x, which is a sum of up to 384 terms: 400 eps.
    np.testing.assert_allclose(
        weights[0].detach().double().cpu(), exact_weights.astype(float), rtol=0, atol=400 * mode.eps
    )
    np.testing.assert_allclose(transmittance.item(), float(exact_left), rtol=0, atol=400 * mode.eps)


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("ray", RAYS)
def test_gradients_of_compositing_are_those_of_float64(ray: str, depth: float, mode: Mode, device: torch.device):
    starts, ends = (edges[None].to(device, mode.dtype) for edges in along(2.0**-7))
    sigmas = (RAYS[ray](depth)[None] / 2.0**-7).to(device, mode.dtype)
    rgbs = torch.rand(1, NUM_SAMPLES, 3, generator=torch.Generator().manual_seed(0)).to(device, mode.dtype)

    def gradients(dtype: torch.dtype) -> tuple[Tensor, ...]:
        inputs = [sigmas.to(dtype).requires_grad_(), rgbs.to(dtype).requires_grad_()]
        with mode.context(device):
            rgb, weights, transmittance = composite(*inputs, starts.to(dtype), ends.to(dtype))
        return torch.autograd.grad(rgb.sum() + (weights * starts.to(dtype)).sum() + transmittance.sum(), inputs)

    # Sums over 384 samples of terms of size 4 (colours and distances): 384 * 4 eps, and more where they cancel.
    for ours, exact in zip(gradients(mode.dtype), gradients(torch.float64), strict=True):
        torch.testing.assert_close(ours.double(), exact, rtol=0, atol=5000 * mode.eps)


@pytest.mark.parametrize("delta", [0.0, 1e-38, 1e-6, 1.0, 1e6])
@pytest.mark.parametrize("sigma", [0.0, 1e-38, 1e-6, 1.0, 1e6, 1e30])
def test_any_pair_of_density_and_interval_is_finite(sigma: float, delta: float, mode: Mode, device: torch.device):
    edges = torch.arange(17, device=device, dtype=mode.dtype) * delta
    sigmas = torch.full((1, 16), sigma, device=device, dtype=mode.dtype).requires_grad_()
    rgbs = torch.ones(1, 16, 3, device=device, dtype=mode.dtype)

    with mode.context(device):
        rgb, weights, transmittance = composite(sigmas, rgbs, edges[None, :-1], edges[None, 1:])
    (gradient,) = torch.autograd.grad(rgb[..., 0].sum() + transmittance.sum(), sigmas)

    assert is_finite(rgb, weights, transmittance, gradient)
    # Where nothing else is on the ray, light that is stopped and light that passes add up: white on white stays white,
    # so the density has no influence. What is left is rounding, times the interval.
    assert gradient.abs().max() <= 100 * mode.eps * delta


@pytest.mark.parametrize("depth", [1e-30, 1e-20, 1e-12, 1e-8, 1e-4, 1.0])
def test_thin_fog_keeps_all_its_digits(depth: float, mode: Mode, device: torch.device):
    sigmas = torch.full((1, 1), depth, device=device, dtype=mode.dtype)
    edges = torch.tensor([[0.0, 1.0]], device=device, dtype=mode.dtype)

    _, weights, _ = composite(sigmas, torch.ones(1, 1, 3, device=device, dtype=mode.dtype), edges[:, :1], edges[:, 1:])

    # 1 - exp(-x) would be 0 below 1e-7; expm1 is right to a few eps at any size.
    torch.testing.assert_close(weights.double(), -torch.expm1(-sigmas.double()), rtol=4 * mode.eps, atol=0)


@pytest.mark.parametrize("num_rays, num_samples", [(0, 4), (3, 1), (3, 0)])
def test_rays_without_samples_and_samples_without_rays(
    num_rays: int, num_samples: int, mode: Mode, device: torch.device
):
    starts, ends = (edges.expand(num_rays, -1).to(device, mode.dtype) for edges in along(0.1, num_samples))
    sigmas = torch.ones(num_rays, num_samples, device=device, dtype=mode.dtype)

    rgb, weights, transmittance = composite(sigmas, sigmas[..., None].expand(-1, -1, 3), starts, ends)

    assert rgb.shape == (num_rays, 3) and weights.shape == sigmas.shape and is_finite(rgb, transmittance)
    if num_samples == 0:
        assert (transmittance == 1).all() and not rgb.any()


# -- where to look -----------------------------------------------------------------------------------------------------

WEIGHTS: dict[str, Callable[[int], Tensor]] = {
    "nothing": lambda n: torch.zeros(n),
    "flat": lambda n: torch.ones(n),
    "first_bin": lambda n: torch.eye(1, n)[0],
    "last_bin": lambda n: torch.eye(1, n)[0].flip(0),
    "one_bin": lambda n: torch.nn.functional.one_hot(torch.tensor(n // 2), n).double(),
    "denormal": lambda n: torch.full((n,), 1e-42),
    "tiny": lambda n: torch.full((n,), 1e-20),
    "huge": lambda n: torch.full((n,), 1e6),
    "tiny_and_huge": lambda n: torch.where(torch.arange(n) % 2 == 0, 1e-20, 1e6),
    "spikes": lambda n: (torch.arange(n) % 50 == 49).double(),
}


@pytest.mark.parametrize("num_bins", [1, 2, 126, 100_000])
@pytest.mark.parametrize("weights", WEIGHTS)
def test_drawn_samples_are_where_the_weights_are(weights: str, num_bins: int, mode: Mode, device: torch.device):
    bins = torch.linspace(0.3, 5.0, num_bins + 1, dtype=torch.float64).to(device, mode.dtype)[None]
    values = WEIGHTS[weights](num_bins).to(device, mode.dtype)[None]
    u = torch.cat([even_quantiles(256, 1, device), torch.tensor([[0.0, 1.0 - 2.0**-24]], device=device)], dim=1)

    with mode.context(device):
        t = sample_pdf(bins, values, u)

    assert is_finite(t) and t.dtype == mode.dtype
    assert (t >= bins[0, 0]).all() and (t <= bins[0, -1]).all() and (t[0, :256].diff() >= 0).all()
    # What was asked for: the share of (padded) weight below each sample, known to a few eps. Cumulated sums of float32
    # are carried in float64 (on a GPU: in a tree); those of float64 err by up to one eps per term, here and above.
    padded = values.double() + 1e-5
    share = torch.nn.functional.pad((padded / padded.sum()).cumsum(-1), (1, 0))[0]
    upper = torch.searchsorted(bins[0].double(), t[0].double().contiguous(), right=True).clamp(1, num_bins)
    inside = (t[0].double() - bins[0, upper - 1]) / (bins[0, upper] - bins[0, upper - 1]).double()
    reached = share[upper - 1] + inside * (share[upper] - share[upper - 1])
    # In float32 neighbouring edges of 100,000 bins differ by 200 eps, so a place within a bin is known to 1 %.
    resolution = float((share.diff() * mode.eps * 5.0 * num_bins / 4.7).max())
    torch.testing.assert_close(
        reached, u[0].double(), rtol=0, atol=1000 * mode.eps + 2 * num_bins * 2.0**-52 + 4 * resolution
    )


def test_bins_without_width_are_harmless(mode: Mode, device: torch.device):
    bins = torch.tensor([[0.3, 0.3, 1.0, 1.0, 1.0, 2.0, 2.0]], device=device, dtype=mode.dtype)
    weights = torch.tensor([[1.0, 1.0, 5.0, 0.0, 1.0, 1.0]], device=device, dtype=mode.dtype)

    t = sample_pdf(bins, weights, even_quantiles(64, 1, device))

    assert is_finite(t) and (t >= 0.3).all() and (t <= 2.0).all() and (t.diff() >= 0).all()


@pytest.mark.parametrize("u", [[-0.5, 0.0], [1.0, 1.5]])
def test_quantiles_outside_stay_on_the_ray(u: list[float], mode: Mode, device: torch.device):
    bins = torch.linspace(0.3, 5.0, 9, device=device, dtype=mode.dtype)[None]

    t = sample_pdf(bins, torch.ones(1, 8, device=device, dtype=mode.dtype), torch.tensor([u], device=device))

    assert is_finite(t) and (t >= bins[0, 0]).all() and (t <= bins[0, -1]).all()


@pytest.mark.parametrize("near, far", [(0.0, 1e-6), (0.0, 1.0), (0.3, 5.0), (1e6, 1e6 + 4.0), (0.0, 1e6)])
@pytest.mark.parametrize("has_noise", [False, True])
def test_stratified_samples_ascend_between_near_and_far(
    near: float, far: float, has_noise: bool, mode: Mode, device: torch.device
):
    noise = None
    if has_noise:
        noise = torch.rand(5, 128, generator=torch.Generator().manual_seed(0), dtype=mode.dtype).to(device)

    with mode.context(device):
        t = stratified_samples(near, far, 128, 5, noise).to(device)

    # The planes themselves are rounded to the precision of the samples.
    assert is_finite(t) and (t.diff(dim=-1) >= 0).all()
    assert (t >= near - mode.eps * far).all() and (t <= far + 2e-7 * far).all()
