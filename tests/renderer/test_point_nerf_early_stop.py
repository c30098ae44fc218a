"""Leaving out samples that hardly any light reaches: off by no more than the derived bound, and fewer evaluations."""

import pytest
import torch

from tests.renderer.small_renderer import assert_same, gradients_of, rays_of, renderer_of, scene
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.bounds import early_stop_error
from vpd_lightning.renderer.early_stop import front_to_back
from vpd_lightning.renderer.point_nerf import PointNeRFRenderer
from vpd_lightning.renderer.rays.volumetric import ray_weights
from vpd_lightning.types import Particles

NEAR, FAR = 0.5, 4.0


def dense_renderer(seed: int, density: float, **changes: object) -> PointNeRFRenderer:
    """A renderer whose rays are opaque after a part of the way; how soon is up to ``density`` (per metre)."""
    renderer = renderer_of(seed, **changes)
    with torch.no_grad():
        renderer.fine.density.weight.mul_(density)
        renderer.fine.density.bias.fill_(density / 4)
        renderer.fine.color.weight.mul_(6)  # so that colours differ
    return renderer


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_error_of_a_thousand_scenes_stays_below_the_bound(dtype: torch.dtype) -> None:
    num_stopped = 0
    largest = 0.0
    for seed in range(20):
        eps = (0.3, 0.1, 0.03, 0.001)[seed % 4]
        density = 10.0 ** (seed % 5 - 1)
        exact = dense_renderer(seed, density).to(dtype).eval()
        stopped = dense_renderer(seed, density, early_stop=eps, num_stop_segments=2 + seed % 7).to(dtype).eval()
        particles, rays = scene(50, 20).to(dtype), rays_of(50, 3).to(dtype)
        with torch.no_grad():
            whole, some = exact(particles, rays, None), stopped(particles, rays, None)
        bound = early_stop_error(eps, NEAR, FAR)
        # Rounding of float32 is far below the smallest eps.
        assert float((whole.rgbs - some.rgbs).abs().max()) <= bound.color
        assert float((whole.depths - some.depths).abs().max()) <= bound.depth
        assert float((whole.opacities - some.opacities).abs().max()) <= bound.opacity
        num_stopped += int((whole.opacities - some.opacities > 1e-5).sum())
        largest = max(largest, float((whole.rgbs - some.rgbs).abs().max()) / eps)
    # Not one of these holds if nothing is ever left out.
    assert num_stopped > 100 and largest > 0.01


def test_gradients_are_off_by_less_than_the_bound() -> None:
    num_rays, num_samples, eps = 1000, 24, 0.05
    taus = torch.rand(num_rays, num_samples, dtype=torch.float64) * torch.logspace(-2, 0.5, num_rays)[:, None].double()
    colors = torch.rand(num_rays, num_samples, 3, dtype=torch.float64)
    # Intervals of one metre make densities and optical depths the same numbers.
    t = torch.arange(num_samples, dtype=torch.float64).expand(num_rays, num_samples)
    gradients, values = [], []
    for is_stopped in (False, True):
        sigmas, rgbs = taus.clone().requires_grad_(), colors.clone().requires_grad_()
        seen = (sigmas, rgbs)
        if is_stopped:
            seen = front_to_back(lambda rays, part: (sigmas[rays, part], rgbs[rays, part]), t, t + 1, eps, 6)  # noqa: B023
        weights, left = ray_weights(seen[0], t, t + 1)
        color = (weights[..., None] * seen[1]).sum(dim=1) + left[:, None] * seen[1][:, -1]
        values.append(color)
        # One channel at a time: the bound is per channel.
        gradients.append(torch.autograd.grad(color[:, 0].sum(), [sigmas, rgbs]))
    assert 0 < float((values[0] - values[1]).detach().abs().max()) < eps
    for whole, some in zip(*gradients, strict=True):
        assert 0 < float((whole - some).abs().max()) < eps


def test_rays_that_are_stopped_are_not_evaluated_again() -> None:
    t = torch.arange(12.0).expand(3, 12)
    sigmas = torch.zeros(3, 12)
    sigmas[0, 1] = 100.0  # opaque at once
    sigmas[1, 5] = 100.0  # opaque in the second of three parts
    rgbs = torch.rand(3, 12, 3)
    calls = []

    def evaluate(rays: torch.Tensor, part: slice) -> tuple[torch.Tensor, torch.Tensor]:
        calls.append((rays.tolist(), part.start, part.stop))
        return sigmas[rays, part], rgbs[rays, part]

    found, colors = front_to_back(evaluate, t, t + 1, 1e-3, 3)
    assert calls == [([0, 1, 2], 0, 4), ([1, 2], 4, 8), ([2], 8, 12)]
    assert torch.equal(found, sigmas) and torch.equal(colors[2], rgbs[2])
    assert torch.equal(colors[0, 4:], rgbs[0, 3:4].expand(8, 3))


def test_nothing_is_evaluated_behind_opaque_walls_and_all_of_what_is_empty() -> None:
    t, evaluated = torch.arange(10.0).expand(2, 10), 0

    def evaluate(rays: torch.Tensor, part: slice) -> tuple[torch.Tensor, torch.Tensor]:
        nonlocal evaluated
        evaluated += len(rays) * (part.stop - part.start)
        return sigmas[rays, part], torch.ones(len(rays), part.stop - part.start, 3)

    for density, expected in ((0.0, 20), (1e6, 4)):
        sigmas, evaluated = torch.full((2, 10), density), 0
        front_to_back(evaluate, t, t + 1, 0.5, 5)
        assert evaluated == expected


@pytest.mark.parametrize("changes", [{}, {"reuse_coarse": False}, {"num_stop_segments": 100}, {"ray_chunk_size": 3}])
def test_a_threshold_that_nothing_falls_below_changes_nothing(changes: dict) -> None:
    particles, rays, keys = scene(), rays_of(), RandomKeys(0, 3, [0, 1])
    plain, stopping = renderer_of(), renderer_of(early_stop=1e-300, **changes)
    assert_same(plain(particles, rays, keys), stopping(particles, rays, keys))
    expected = gradients_of(plain, particles, rays, keys)
    for one, other in zip(gradients_of(stopping, particles, rays, keys), expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("changes", [{"checkpoint_chunks": True}, {"ray_chunk_size": 4}, {"reuse_coarse": False}])
def test_training_with_early_stop_does_not_depend_on_the_other_switches(changes: dict) -> None:
    particles, rays, keys = scene(), rays_of(), RandomKeys(0, 3, [0, 1])
    settings = {"early_stop": 0.2, "num_stop_segments": 5}
    plain, other = dense_renderer(0, 5.0, **settings), dense_renderer(0, 5.0, **settings, **changes)
    assert_same(plain(particles, rays, keys), other(particles, rays, keys))
    expected = gradients_of(plain, particles, rays, keys)
    exact = gradients_of(dense_renderer(0, 5.0), particles, rays, keys)
    assert any(not torch.allclose(one, two) for one, two in zip(exact, expected, strict=True))  # something was left out
    for one, two in zip(gradients_of(other, particles, rays, keys), expected, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("num_rays", [1, 4])
@pytest.mark.parametrize("density", [1e-9, 1e6])
def test_empty_and_opaque_rays_of_hardly_any_particles(count: int, num_rays: int, density: float) -> None:
    particles, rays = scene(count=count), rays_of(count=num_rays)
    rendered = dense_renderer(0, density, early_stop=0.1)(particles, rays, None)
    exact = dense_renderer(0, density)(particles, rays, None)
    assert float((rendered.rgbs - exact.rgbs).detach().abs().max()) <= 0.1
    rendered.rgbs.sum().backward()


def test_a_batch_equals_its_members() -> None:
    particles, rays = scene(3), rays_of(3)
    renderer = dense_renderer(0, 5.0, early_stop=0.2).eval()
    together = renderer(particles, rays, None)
    for member in range(3):
        part = slice(member, member + 1)
        alone = renderer(
            Particles(particles.positions[part], particles.features[part]),
            type(rays)(rays.origins[part], rays.directions[part]),
            None,
        )
        torch.testing.assert_close(together.rgbs[part], alone.rgbs, rtol=1e-9, atol=1e-10)
