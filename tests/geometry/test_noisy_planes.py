"""The parts of the fit of wide planes, against what they replace."""

import numpy as np
import pytest

from vpd_lightning.geometry.noisy_planes import _fit, _median, _ransac, off_wide_planes


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


def _table_scene(table_half: float, noise: float = 0.003) -> tuple[np.ndarray, ...]:
    """A box on a table before rubble far behind it: depth, rays, centre, and which pixels show the box."""
    height, width = 96, 128
    rows, columns = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(columns - 64) / 100, (rows - 48) / 100, np.ones((height, width))], axis=-1)
    draw = np.random.default_rng(0)
    depth = draw.uniform(2.3, 3.3, (height, width))  # no plane
    depth[draw.uniform(size=depth.shape) > 0.2] = 0
    # The table lies 0.5 m below the camera, from 1 m away on; y goes down.
    with np.errstate(divide="ignore"):
        down = np.where(rays[..., 1] > 0, 0.5 / rays[..., 1], np.inf)
    on_table = (down > 1.0) & (down < 1.0 + 2 * table_half) & (np.abs(rays[..., 0] * down) < table_half)
    depth = np.where(on_table, down, depth)
    box = (np.abs(rays[..., 0]) < 0.08) & (np.abs(rays[..., 1] - 0.3) < 0.06)
    depth = np.where(box, 1.3, depth)
    return depth * (1 + noise * draw.normal(size=depth.shape)), rays, np.zeros((1, 3)), box, on_table & ~box


def _masks(table_half: float) -> tuple[np.ndarray | None, np.ndarray, np.ndarray]:
    depth, rays, centers, box, table = _table_scene(table_half)
    sizes, noise = np.array([0.01]), np.array([0.003])
    valid = depth[None] > 0
    found = off_wide_planes(depth[None], rays[None], centers, valid, noise, sizes, min_width=0.4)
    return (None if found is None else found[0]), box, table


def test_a_table_stands_still_although_much_more_is_seen_behind_it() -> None:
    found, box, table = _masks(0.6)
    assert found is not None and table.mean() > 0.1
    assert found[box].mean() > 0.95 and found[table].mean() < 0.02


def test_a_plane_that_is_small_may_move_however_near_it_is() -> None:
    found, _, table = _masks(0.25)
    assert table.mean() > 0.04 and found is not None and found[table].mean() > 0.95


def test_what_is_above_the_horizon_moves_unless_it_hangs_alone() -> None:
    """There no ray meets the floor, and how far a pixel lies behind it is infinite."""
    draw = np.random.default_rng(0)
    rows, columns = np.mgrid[:96, :128] + 0.5
    rays = np.stack([(columns - 64) / 100, (rows - 40) / 100, np.ones((96, 128))], axis=-1)
    with np.errstate(divide="ignore"):
        floor = np.where(rays[..., 1] > 0.05, 0.5 / rays[..., 1], 0.0)
    ball = (columns - 64) ** 2 + (rows - 25) ** 2 < 12**2
    depth = np.where(
        ball, 3 - np.sqrt(np.maximum(0.36**2 - (0.03 * (columns - 64)) ** 2 - (0.03 * (rows - 25)) ** 2, 0)), floor
    )
    alone = np.zeros_like(ball)
    alone[5:15:5, 10:120:10] = True
    depth = np.where(alone, 2.0, depth) * (1 + 0.003 * draw.normal(size=depth.shape))

    found = off_wide_planes(
        depth[None], rays[None], np.zeros((1, 3)), depth[None] > 0, np.array([0.003]), np.array([0.01]), min_width=0.4
    )

    assert found is not None
    assert found[0][ball].mean() > 0.98
    assert not found[0][alone].any() and not found[0][(floor > 0) & ~ball].any()
