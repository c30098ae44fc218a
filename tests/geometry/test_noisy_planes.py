"""The parts of the fit of wide planes, against what they replace."""

import numpy as np
import pytest

from vpd_lightning.geometry.noisy_planes import _fit, _median, _ransac


@pytest.mark.parametrize("count", [1, 2, 20, 21, 700])
def test_the_median_is_that_of_numpy(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    assert _median(values) == np.median(values)


@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_a_fitted_plane_is_that_of_the_singular_vectors(offset: float) -> None:
    draw = np.random.default_rng(0)
    points = draw.normal(size=(500, 3)) * [2.0, 1.0, 1e-3] @ np.linalg.qr(draw.normal(size=(3, 3)))[0] + offset
    weights = draw.uniform(0.5, 2.0, len(points))
    shares = weights**2 / (weights**2).sum()
    middle = shares @ points
    _, _, axes = np.linalg.svd((points - middle) * np.sqrt(shares)[:, None], full_matrices=False)

    plane = _fit(points, weights)

    # Rounding of squares (2e-16 * 4 m2) beside the spread of the next axis (1 m2), and of the points themselves.
    np.testing.assert_allclose(plane[:3] * np.sign(plane[:3] @ axes[2]), axes[2], atol=1e-13 + 1e-15 * offset)
    assert plane[3] == pytest.approx(plane[:3] @ middle, abs=1e-12 + 1e-14 * offset)


@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_the_plane_with_most_support_is_found_wherever_the_world_lies(offset: float) -> None:
    draw = np.random.default_rng(0)
    floor = np.column_stack([draw.uniform(-1, 1, (800, 2)), 1e-3 * draw.normal(size=800)])
    others = draw.uniform(-1, 1, (400, 3)) + [0, 0, 1.5]
    center = np.array([0.0, -2.0, 2.0])
    points = np.concatenate([floor, others])
    rays = points - center
    sigma = 1e-3 * np.ones(len(points))

    plane = _ransac(points + offset, rays, sigma, np.random.default_rng(1))

    assert abs(plane[2]) > 0.999
    assert plane[:3] @ np.full(3, offset) == pytest.approx(plane[3], abs=0.01)
