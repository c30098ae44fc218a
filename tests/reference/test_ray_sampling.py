"""Hierarchical sampling against the inverse of the cumulative distribution, in float64 loops."""

import numpy as np
import pytest
import torch

from tests.reference import reference_sampling as reference
from vpd_lightning.geometry.ray_sampling import sample_pdf

NUM_RAYS, NUM_BINS, NUM_SAMPLES = 5, 14, 40


def _distributions(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    bins = np.sort(generator.uniform(0.3, 5.0, (NUM_RAYS, NUM_BINS + 1)), axis=1)
    weights = generator.uniform(0.01, 1.0, (NUM_RAYS, NUM_BINS))
    weights[0] /= 10
    u = np.sort(generator.uniform(size=(NUM_RAYS, NUM_SAMPLES)), axis=1)
    u[:, 0], u[:, -1] = 0.0, 1.0
    return bins, weights, u


# float32: a cumulative sum of up to 14 shares carries about 1e-6; the steepest slope here (bin width over share, up to
# 2 m / 0.001) turns it into 2e-3 at worst, in bins with hardly any mass.
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 2e-3)])
def test_hierarchical_samples_match_the_loops(dtype: torch.dtype, tolerance: float) -> None:
    bins, weights, u = _distributions(0)
    found = sample_pdf(*[torch.from_numpy(array).to(dtype) for array in (bins, weights, u)])
    np.testing.assert_allclose(found.numpy(), reference.sample_pdf(bins, weights, u), rtol=tolerance, atol=tolerance)


def test_a_ray_without_density_is_sampled_uniformly() -> None:
    bins = np.linspace(1.0, 3.0, NUM_BINS + 1)[None]
    u = np.linspace(0.0, 1.0, 9)[None]
    arrays = (bins, np.zeros((1, NUM_BINS)), u)
    found = sample_pdf(*[torch.from_numpy(array) for array in arrays]).numpy()
    np.testing.assert_allclose(found, reference.sample_pdf(*arrays), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found, 1.0 + 2.0 * u, rtol=1e-6, atol=1e-6)


def test_all_mass_in_one_bin_puts_nearly_all_samples_there() -> None:
    bins = np.linspace(0.0, 1.0, NUM_BINS + 1)[None]
    weights = np.zeros((1, NUM_BINS))
    weights[0, 6] = 1.0
    u = np.linspace(0.01, 0.99, 50)[None]
    found = sample_pdf(*[torch.from_numpy(array) for array in (bins, weights, u)]).numpy()
    assert found.min() >= bins[0, 6] and found.max() <= bins[0, 7]
    np.testing.assert_allclose(found, reference.sample_pdf(bins, weights, u), rtol=1e-6, atol=1e-6)


def test_samples_carry_no_gradient_and_stay_inside_the_bins() -> None:
    bins, weights, u = (torch.from_numpy(array) for array in _distributions(3))
    found = sample_pdf(bins.requires_grad_(), weights.requires_grad_(), u)
    assert not found.requires_grad
    assert (found >= bins[:, :1]).all() and (found <= bins[:, -1:]).all()
    assert (found.diff(dim=1) >= 0).all(), "sorted uniforms must give sorted samples"
