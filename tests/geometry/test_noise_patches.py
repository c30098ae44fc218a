"""Neighbours err alike: patches of noise on a floor are no bodies, and a small body still is one."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter

from vpd_lightning.geometry.noisy_planes import off_wide_planes

_SIZE, _NOISE = 64, 0.005


def _seen(draw: np.random.Generator, body: slice | None = None, height: float = 0.0) -> Bool[np.ndarray, "1 64 64"]:
    """Return what may move on a floor seen from 2.5 m at 45 degrees, where noise is alike over about three pixels.

    ``body`` are rows and columns that show something ``height`` metres above the floor.
    """
    down, right = (np.mgrid[:_SIZE, :_SIZE] + 0.5 - _SIZE / 2) / _SIZE
    ahead, below = np.array([0.0, 1.0, -1.0]) / np.sqrt(2), np.array([0.0, -1.0, -1.0]) / np.sqrt(2)
    rays = ahead + right[..., None] * [1.0, 0.0, 0.0] + down[..., None] * below
    top = np.zeros((_SIZE, _SIZE))
    if body is not None:
        top[body, body] = height
    depth = (top - 1.8) / rays[..., 2]
    depth = depth * (1 + _alike(draw))
    return off_wide_planes(
        depth[None],
        rays[None],
        np.array([[0.0, 0.0, 1.8]]),
        np.ones((1, _SIZE, _SIZE), bool),
        np.array([_NOISE]),
        np.array([1 / _SIZE]),
        min_width=0.3,
    )


def _alike(draw: np.random.Generator) -> Float[np.ndarray, "64 64"]:
    noise = gaussian_filter(draw.normal(size=(_SIZE, _SIZE)), 1.2, mode="wrap")
    return _NOISE * noise / noise.std()


def test_patches_of_noise_are_no_bodies() -> None:
    found = [int(_seen(np.random.default_rng(seed)).sum()) for seed in range(40)]

    assert sum(found) <= 20, found


def test_a_small_body_is_found() -> None:
    body = slice(30, 34)  # 16 pixels, some eight standard deviations of depth above the floor
    hits = [int(_seen(np.random.default_rng(seed), body, 0.07)[0, body, body].sum()) for seed in range(20)]

    assert np.mean(hits) > 14, hits
