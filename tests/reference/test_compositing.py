"""composite against NeRF's quadrature in float64 loops, and its gradients against finite differences."""

import numpy as np
import pytest
import torch

from tests.reference import reference_compositing as reference
from vpd_lightning.renderer.rays.volumetric import composite


def _rays(seed: int, num_rays: int = 6, num_samples: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Thin, middling and opaque rays with uneven intervals, one with gaps of zero length and zero density."""
    generator = np.random.default_rng(seed)
    edges = np.sort(generator.uniform(0.3, 5.0, (num_rays, num_samples + 1)), axis=1)
    sigmas = generator.exponential(1.0, (num_rays, num_samples)) * 10.0 ** np.linspace(-3, 2, num_rays)[:, None]
    sigmas[0, ::3] = 0
    edges[1, 5] = edges[1, 4]
    return sigmas, generator.uniform(size=(num_rays, num_samples, 3)), edges[:, :-1].copy(), edges[:, 1:].copy()


# float32: t reaches 5, so that an interval carries an error of 2^-22 and, at densities of up to 5e2, an optical depth
# one of 1e-4 times a weight that has decayed by then; 1e-4 covers weights and colours.
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 1e-4)])
def test_compositing_matches_the_loops(dtype: torch.dtype, tolerance: float) -> None:
    arrays = _rays(0)
    found = composite(*[torch.from_numpy(array).to(dtype) for array in arrays])
    for tensor, expected in zip(found, reference.composite(*arrays), strict=True):
        assert tensor.dtype == dtype
        np.testing.assert_allclose(tensor.numpy(), expected, rtol=tolerance, atol=tolerance)


def test_one_opaque_and_one_empty_ray_have_the_values_of_the_closed_form() -> None:
    sigmas = torch.tensor([[1e9, 1.0], [0.0, 0.0]], dtype=torch.float64)
    rgbs = torch.rand(2, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    starts = torch.tensor([[1.0, 2.0]], dtype=torch.float64).expand(2, 2)
    rgb, weights, left_over = composite(sigmas, rgbs, starts, starts + 1)
    torch.testing.assert_close(weights, torch.tensor([[1.0, 0.0], [0.0, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(rgb, torch.stack([rgbs[0, 0], torch.zeros(3, dtype=torch.float64)]))
    torch.testing.assert_close(left_over, torch.tensor([0.0, 1.0], dtype=torch.float64))


@pytest.mark.parametrize("seed", [0, 1])
def test_gradients_match_finite_differences(seed: int) -> None:
    generator = np.random.default_rng(seed)
    edges = np.sort(generator.uniform(0.3, 5.0, (3, 6)), axis=1)
    arrays = (generator.exponential(1.0, (3, 5)), generator.uniform(size=(3, 5, 3)), edges[:, :-1], edges[:, 1:])
    inputs = [torch.from_numpy(array.copy()).requires_grad_() for array in arrays]
    assert torch.autograd.gradcheck(composite, inputs, eps=1e-6, atol=1e-6, rtol=1e-4)
