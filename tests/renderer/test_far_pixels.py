"""What measured no distance is drawn behind everything else, in the direction in which it was seen."""

import math

import numpy as np
import pytest
import torch

from tests.renderer.test_splat_scenery import GRAY, RED, ball, renderer, tensor
from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.renderer.far_pixels import seen_far
from vpd_lightning.renderer.scenery_layer import SceneryLayer
from vpd_lightning.types import Cameras, Particles, Rays, Scenery

SIZE, FOCAL, HORIZON, HEIGHT = 16, 20.0, 7, 1.0
"""Pixels, pixels, the first row of floor, and metres of the camera above the floor."""

SKY = [0.2, 0.3, 0.9]


def camera():
    """A level camera above the origin that looks along y."""
    intrinsics = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, HORIZON - 1], [0, 0, 1]], dtype=torch.float64)
    pose = tensor([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, HEIGHT], [0, 0, 0, 1]])
    return Cameras(intrinsics, pose, SIZE, SIZE)


def outdoors(sky=SKY):
    """A floor below a sky, a point or a direction for each pixel of the camera; and the rays of the pixels."""
    rays = pixel_rays(camera())
    origins, directions = (part.flatten(0, -2)[None] for part in (rays.origins, rays.directions))
    is_floor = (torch.arange(SIZE * SIZE) >= HORIZON * SIZE)[None]
    distance = torch.where(is_floor, -HEIGHT / directions[..., 2], 0.0)
    depth = distance * directions[..., 1]
    colors = torch.where(is_floor[..., None], tensor(GRAY), tensor(sky))
    return Scenery(
        positions=torch.where(is_floor[..., None], origins + distance[..., None] * directions, 0.0),
        colors=colors,
        normals=tensor([0.0, 0.0, 1.0]).expand_as(colors),
        views=directions,
        sizes=torch.where(is_floor, depth, 1.0) / FOCAL,
        mask=is_floor,
        occluders=colors[:, :0],
        occluder_mask=is_floor[:, :0],
        far_mask=~is_floor,
    ), Rays(origins, directions)


def layer(**changes):
    settings = {
        "num_candidates": 12,
        "near": 0.1,
        "backend": "torch",
        "elliptic": True,
        "far_pixels": True,
        "seen_through": True,
    }
    return SceneryLayer(**settings | changes).double()


def shown(seen):
    """Colours in front of black."""
    return seen.opacities[..., None] * seen.colors + (1 - seen.opacities[..., None]) * seen.behind


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_directions_see_what_plain_loops_see(backend):
    generator = torch.Generator().manual_seed(0)
    views = torch.nn.functional.normalize(torch.randn(1, 60, 3, generator=generator, dtype=torch.float64), dim=-1)
    scenery, _ = outdoors()
    scenery = Scenery(
        **{name: getattr(scenery, name)[:, :60] for name in ("positions", "normals", "mask", "occluders")},
        occluder_mask=scenery.occluder_mask,
        colors=torch.rand(1, 60, 3, generator=generator, dtype=torch.float64),
        views=views,
        sizes=0.2 + 0.1 * torch.rand(1, 60, generator=generator, dtype=torch.float64),
        far_mask=(torch.arange(60) < 50)[None],
    )
    directions = torch.nn.functional.normalize(torch.randn(1, 30, 3, generator=generator, dtype=torch.float64), dim=-1)
    rays = Rays(torch.randn(1, 30, 3, generator=generator, dtype=torch.float64), directions)

    found = seen_far(scenery, rays, torch.tensor(0.8, dtype=torch.float64), backend)

    pixels = list(zip(*(part[0, :50].numpy() for part in (views, scenery.colors, scenery.sizes)), strict=True))
    for number, direction in enumerate(directions[0].numpy()):
        ahead = [pixel for pixel in pixels if pixel[0] @ direction >= 0]
        ahead.sort(key=lambda pixel: np.linalg.norm(pixel[0] - (pixel[0] @ direction) * direction))
        spread = [np.linalg.norm(view - direction) / size for view, _, size in ahead[:4]]
        weights = [math.exp(-0.5 * (s / 0.8) ** 2) / size**2 for s, (_, _, size) in zip(spread, ahead, strict=False)]
        color = sum(w * c for w, (_, c, _) in zip(weights, ahead, strict=False)) / sum(weights)
        np.testing.assert_allclose(found.colors[0, number].numpy(), color, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(float(found.nearest[0, number]), min(spread), rtol=1e-9)
        opacity = 1 / (1 + math.exp(-16 * (1.5 - min(spread))))
        np.testing.assert_allclose(float(found.opacities[0, number]), opacity, rtol=1e-6, atol=1e-12)


def test_a_camera_sees_sky_and_floor_up_to_the_row_where_they_meet():
    scenery, rays = outdoors()

    with_sky, without = (shown(layer(far_pixels=on)(scenery, rays)) for on in (True, False))

    assert (with_sky - scenery.colors).abs().max() < 0.1  # at the rim a twelfth of the other shows through
    away_from_the_rim = torch.ones(SIZE, SIZE, dtype=torch.bool)
    away_from_the_rim[HORIZON - 1 : HORIZON + 1] = False
    assert (with_sky - scenery.colors)[0][away_from_the_rim.flatten()].abs().max() < 1e-3
    row = slice((HORIZON - 1) * SIZE, HORIZON * SIZE)
    assert (without[0, row] - tensor(GRAY)).abs().max() < 0.01  # the floor would reach over its rim


def test_the_sky_is_the_same_from_everywhere_and_behind_the_floor():
    scenery, rays = outdoors()
    up = slice(0, 4 * SIZE)
    elsewhere = Rays(rays.origins + tensor([3.0, -2.0, 40.0]), rays.directions)
    torch.testing.assert_close(shown(layer()(scenery, elsewhere))[0, up], scenery.colors[0, up], rtol=0, atol=1e-3)
    above = Rays(rays.origins + tensor([0.0, 0.0, 0.3]), rays.directions)  # the floor ahead hides a part of the sky
    seen = shown(layer()(scenery, above))[0]
    assert (seen[9 * SIZE :] - tensor(GRAY)).abs().max() < 0.02


def test_without_a_far_pixel_nothing_changes_and_what_was_not_seen_is_left_to_the_background():
    scenery, rays = outdoors()
    none = Scenery(**{**vars(scenery), "far_mask": None})
    for one, other in zip(layer()(none, rays), layer(far_pixels=False)(none, rays), strict=True):
        assert torch.equal(one, other)
    down = Rays(rays.origins, tensor([0.0, -1.0, 0.0]).expand_as(rays.directions))
    background = torch.rand(down.origins.shape, dtype=torch.float64)
    torch.testing.assert_close(layer()(scenery, down, background).behind, background, rtol=0, atol=1e-6)


def test_a_renderer_draws_the_sky_behind_a_body_and_the_same_without_one():
    scenery, rays = outdoors()
    body = ball([0.0, 1.0, 1.2], color=RED)
    model = renderer(num_lights=0).double()
    empty = Particles(body.positions, body.features, mask=body.mask & False, moving=body.moving, scenery=scenery)
    scene = Particles(body.positions, body.features, moving=body.moving, scenery=scenery)

    alone, before = (model(particles, rays, None) for particles in (empty, scene))

    assert (alone.rgbs[0, : 4 * SIZE] - tensor(SKY)).abs().max() < 1e-3
    assert not alone.opacities[0, : 4 * SIZE].gt(1e-3).any()  # nothing is there: depth is that of the far end
    hidden = (before.rgbs - alone.rgbs).abs().amax(dim=-1)[0] > 0.2
    assert 1 <= hidden[: HORIZON * SIZE].sum() < 5 * SIZE


@pytest.mark.parametrize("rows", [(1, 5), (4, 13)])
def test_sky_and_floor_go_on_where_a_body_stood_before_them_and_meet_at_the_horizon(rows):
    scenery, rays = outdoors()
    covered = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    covered[slice(*rows), 4:12] = True  # by a body, when it was observed
    covered = covered.flatten()
    scenery = Scenery(**{**vars(scenery), "mask": scenery.mask & ~covered, "far_mask": scenery.far_mask & ~covered})
    empty = ball([0.0, 1.0, 1.2])
    empty = Particles(empty.positions, empty.features, mask=empty.mask & False, moving=empty.moving, scenery=scenery)
    torch.manual_seed(0)
    plain, going_on = renderer(num_lights=0), renderer(num_lights=0, unseen_ground=True)
    going_on.load_state_dict(plain.state_dict(), strict=False)

    before, after = (model(empty, rays, None).rgbs[0] for model in (plain, going_on))

    true = outdoors()[0].colors[0]
    row = torch.arange(SIZE * SIZE) // SIZE
    is_rim = (row == HORIZON - 1) | (row == HORIZON)
    assert (before - true)[covered].abs().max() > 0.1
    assert (after - true)[covered & ~is_rim].abs().max() < 0.02
    assert (after - true)[covered & is_rim].abs().sum() < 0.1 * SIZE  # of three colours: no row is off
    torch.testing.assert_close(after[~covered], before[~covered], rtol=0, atol=0.02)


def test_the_sky_goes_on_beyond_the_end_of_a_floor():
    """A floor that ends: farther out its plane still meets rays, but sky was seen there on both sides of the hole."""
    scenery, rays = outdoors()
    row = torch.arange(SIZE * SIZE) // SIZE
    ended, hole = row < HORIZON + 2, (row == HORIZON) & (torch.arange(SIZE * SIZE) % SIZE == 8)
    scenery = Scenery(
        **{**vars(scenery), "mask": scenery.mask & ~ended, "far_mask": ended[None] & ~hole,
           "colors": torch.where(ended[:, None], tensor(SKY), tensor(GRAY))[None],
           "sizes": torch.where(ended, 1 / FOCAL, scenery.sizes)}
    )  # fmt: skip
    body = ball([0.0, 1.0, 1.2])
    empty = Particles(body.positions, body.features, mask=body.mask & False, moving=body.moving, scenery=scenery)

    seen = renderer(num_lights=0, unseen_ground=True)(empty, rays, None).rgbs[0]

    assert (seen[hole] - tensor(SKY)).abs().max() < 0.1


def test_the_width_of_a_pixel_learns_from_the_sky():
    scenery, rays = outdoors()
    noisy = torch.rand(scenery.colors.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    scenery = Scenery(**{**vars(scenery), "colors": noisy})
    model = layer()
    turned = torch.nn.functional.normalize(rays.directions + 0.4 / FOCAL, dim=-1)

    model(scenery, Rays(rays.origins, turned)).behind.sum().backward()

    assert model.log_width.grad is not None and torch.isfinite(model.log_width.grad) and model.log_width.grad != 0
