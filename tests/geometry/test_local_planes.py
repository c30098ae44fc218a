"""Planes fitted around every pixel, against the truth and against a plain fit of one pixel after the other."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.geometry.cast_scenes import FLOOR, Box, cast, looking_at
from vpd_lightning.encoder.particles.wide_surface_background import WideSurfaceBackground
from vpd_lightning.geometry import local_planes
from vpd_lightning.geometry.local_planes import plane_depth
from vpd_lightning.types import RGBDFrames

PIXEL = torch.tensor([1 / 60, 1 / 60], dtype=torch.float64)
NOISE = torch.tensor([0.005, 0.005], dtype=torch.float64)
SETTINGS = {"max_slope": 0.15, "max_turn_degrees": 20.0, "min_width": 0.4, "tolerance": 0.5}


def scene():
    """A dark cube on a light floor: true depth and colours of two views, and which pixels show the cube."""
    frames, shown = cast([FLOOR, Box((0, 0, 0.15), 0.15, 0.4)])
    rgb = torch.where((shown[0] == 1)[..., None], 0.2, 0.7).double().expand(*shown[0].shape, 3)
    return frames.depth[0], rgb, shown[0] == 1


def scattered(depth, seed=0, share=0.005):
    draw = torch.Generator().manual_seed(seed)
    return depth * (1 + share * torch.randn(depth.shape, generator=draw, dtype=depth.dtype))


def outline(cube):
    """Pixels of the cube beside others."""
    others = torch.nn.functional.max_pool2d((~cube).float()[:, None], 3, stride=1, padding=1)[:, 0] > 0
    return cube & others


def test_planes_scatter_by_less_than_half():
    depth, rgb, cube = scene()
    noisy = scattered(depth)

    found = plane_depth(noisy, rgb, NOISE, PIXEL)

    for there in (cube, (depth > 0) & ~cube):
        before, after = ((values / depth - 1)[there].abs().median() for values in (noisy, found))
        assert after < 0.5 * before
        # Where two sides of the cube meet, planes cut the edge.
        assert (found / depth - 1)[there].abs().max() < 5 * 0.005


def test_lost_outlines_are_found_again_by_their_colour():
    """Half of the outline is lost, at random; the floor behind is up to half a metre farther."""
    depth, rgb, cube = scene()
    lost = outline(cube) & (torch.rand(depth.shape, generator=torch.Generator().manual_seed(1)) < 0.5)
    noisy = scattered(depth) * ~lost

    found = plane_depth(noisy, rgb, NOISE, PIXEL)

    error = (found / depth - 1)[lost].abs()
    assert (found[lost] > 0).float().mean() > 0.95
    assert error.median() < 0.005 and (error < 0.03).float().mean() > 0.75


def test_without_colours_to_tell_two_surfaces_apart_what_was_measured_stays_on_its_own():
    depth, rgb, cube = scene()
    noisy = scattered(depth)

    found = plane_depth(noisy, torch.full_like(rgb, 0.5), NOISE, PIXEL)

    assert ((found / noisy - 1).abs()[depth > 0] < 4.5 * 0.005).all()
    assert (found / depth - 1)[cube].abs().median() < 0.004


def test_a_plain_fit_of_single_pixels_gives_the_same():
    """Weights and equations as the docstring says them, one pixel at a time, in NumPy."""
    depth, rgb, _ = scene()
    noisy = scattered(depth)[0].numpy()
    found = plane_depth(torch.from_numpy(noisy)[None], rgb[:1], NOISE[:1], PIXEL[:1])[0]

    for row, column in ((20, 30), (31, 33), (40, 12), (60, 61)):
        assert float(found[row, column]) == pytest.approx(_plain(noisy, rgb[0].numpy(), row, column), rel=1e-9)


def _plain(depth, rgb, row, column, noise=0.005, pixel=1 / 60):
    places, values, weights = [], [], []
    for y in range(row - 3, row + 4):
        for x in range(column - 3, column + 4):
            if 0 <= y < depth.shape[0] and 0 <= x < depth.shape[1] and depth[y, x] > 0:
                apart = np.square(rgb[y, x] - rgb[row, column]).sum() / (2 * 0.1**2)
                places.append((1.0, x - column, y - row))
                values.append(depth[row, column] / depth[y, x] - 1)
                weights.append(np.exp(-apart - ((y - row) ** 2 + (x - column) ** 2) / 8))
    places, values, weights = (np.array(each) for each in (places, values, weights))
    residuals, scale = values, max(3 * noise, 2 * pixel)
    for _ in range(3):
        robust = weights / (1 + (residuals / scale) ** 2) ** 2
        matrix = places.T @ (robust[:, None] * places) + np.diag([1e-6, 0.05, 0.05])
        plane = np.linalg.solve(matrix, places.T @ (robust * values))
        residuals, scale = values - places @ plane, 3 * noise
    return depth[row, column] / (1 + plane[0]) if abs(plane[0]) < 4 * noise else depth[row, column]


def test_what_is_far_from_anything_measured_stays_missing():
    depth, rgb, _ = scene()
    noisy = scattered(depth)
    noisy[:, 20:40, 20:40] = 0

    found = plane_depth(noisy, rgb, NOISE, PIXEL)

    assert (found[:, 24:36, 24:36] == 0).all()
    assert (plane_depth(torch.zeros_like(depth), rgb, NOISE, PIXEL) == 0).all()
    assert (plane_depth(torch.full_like(depth, torch.nan), rgb, NOISE, PIXEL) == 0).all()


def frames(depth, rgb):
    cameras = looking_at(((0.9, -1.1, 1.0), (-1.0, -0.8, 1.1)))
    return RGBDFrames(
        rgb[None].float(),
        depth[None].float(),
        replace(cameras, intrinsics=cameras.intrinsics[None], cam_to_world=cameras.cam_to_world[None]),
    )


def test_exact_depth_is_left_as_it_is_and_noisy_depth_is_kept_for_the_next_time():
    depth, rgb, cube = scene()
    background = WideSurfaceBackground(**SETTINGS, memory_frames=4, noise_floor=0.001)
    exact, noisy = frames(depth, rgb), frames(scattered(depth), rgb)

    (judged, first), (_, again) = background.restored(noisy), background.restored(noisy)

    assert all((depth == exact.depth).all() for depth in background.restored(exact))
    assert (first == again).all()
    assert (judged == noisy.depth)[noisy.depth > 0].float().mean() > 0.98, "what was measured is judged as measured"
    errors = [(values[0] / depth - 1)[cube].abs().median() for values in (first, noisy.depth)]
    assert errors[0] < 0.5 * errors[1]
    never = WideSurfaceBackground(**SETTINGS, memory_frames=4, noise_floor=None)
    assert all((depth == noisy.depth).all() for depth in never.restored(noisy))


def test_no_more_frames_are_kept_than_was_asked_for():
    depth, rgb, _ = scene()
    background = WideSurfaceBackground(**SETTINGS, memory_frames=2, noise_floor=0.001)

    for seed in range(4):
        background.restored(frames(scattered(depth, seed), rgb))

    assert len(background._restored) == 2


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_compiled_loops_find_what_operations_on_images_find(dtype, monkeypatch):
    """Colours with shades, lost pixels, a patch with nothing in reach, what is no number, images that are no copies."""
    pytest.importorskip("numba")
    depth, rgb, _ = scene()
    draw = torch.Generator().manual_seed(2)
    noisy = scattered(depth) * (torch.rand(depth.shape, generator=draw, dtype=depth.dtype) > 0.2)
    noisy[:, 5:20, 5:20] = 0
    noisy[0, 30, 30], noisy[1, 31, 31] = torch.nan, torch.inf
    shades = rgb + 0.05 * torch.rand(rgb.shape, generator=draw, dtype=rgb.dtype)
    given = noisy.to(dtype).mT.contiguous().mT, shades.to(dtype), NOISE, PIXEL

    found = plane_depth(*given)
    monkeypatch.setattr(local_planes, "_compiled", lambda: None)
    expected = plane_depth(*given)

    assert (found == 0).any() and found.dtype == dtype
    torch.testing.assert_close(found, expected, rtol=1e-12 if dtype == torch.float64 else 1e-5, atol=0)
