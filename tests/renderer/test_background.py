"""The ground goes on where no camera saw it: its plane, its colour, and what other cameras teach about it."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from tests.renderer.test_splat_scenery import renderer
from vpd_lightning.renderer.background import Background, Ground, UnseenGround, ground_of
from vpd_lightning.types import Particles, Rays, Scenery

CAMERA = torch.tensor([0.0, -3.0, 2.0], dtype=torch.float64)
UP = normalize(torch.tensor([0.1, -0.2, 1.0], dtype=torch.float64), dim=0)
LEVEL = 0.3


def on_plane(points, normal=UP, level=LEVEL):
    return points - ((points @ normal) - level)[:, None] * normal


def random(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def scenery(points, normals, colors):
    offsets = points - CAMERA
    distances = offsets.norm(dim=-1, keepdim=True)
    mask = torch.ones(1, len(points), dtype=torch.bool)
    return Scenery(
        positions=points[None], colors=colors[None], normals=normals[None], views=(offsets / distances)[None],
        sizes=0.02 * distances.squeeze(-1)[None], mask=mask, occluders=points[None, :0], occluder_mask=mask[:, :0],
    )  # fmt: skip


def tilted_floor(num_floor=600, num_others=400, noise=0.0):
    """A green tilted floor, and points of walls and clutter."""
    floor = on_plane(4 * random(num_floor, 3) - 2) + noise * (random(num_floor, 1, seed=1) - 0.5) * UP
    others = 2 * random(num_others, 3, seed=2) + torch.tensor([-1.0, -1.0, 0.5], dtype=torch.float64)
    away = normalize(random(num_others, 3, seed=3) - 0.5, dim=-1)
    colors = torch.tensor([[0.2, 0.7, 0.3]] * num_floor + [[0.9, 0.1, 0.1]] * num_others, dtype=torch.float64)
    order = torch.randperm(num_floor + num_others, generator=torch.Generator().manual_seed(4))
    normals = torch.cat([UP.expand(num_floor, 3), away])
    return scenery(torch.cat([floor, others])[order], normals[order], colors[order])


def looking(targets, origin=CAMERA):
    directions = normalize(targets - origin, dim=-1)
    return Rays(origin.expand_as(directions)[None], directions[None])


def guess(**changes):
    return UnseenGround(**{"frequencies": 3, "hidden_dim": 64, "length": 2.0, "near": 0.1, **changes}).double()


@pytest.mark.parametrize("num_points", [1, 1000, 9000])
def test_the_plane_of_a_tilted_floor_is_found_among_walls_and_clutter(num_points):
    seen = tilted_floor(-(-num_points * 6 // 10), num_points * 4 // 10)

    ground = ground_of(seen)

    assert ground.found.all()
    torch.testing.assert_close(ground.normals[0], UP, rtol=0, atol=0.02)
    torch.testing.assert_close(ground.heights[0].item(), LEVEL, rtol=0, atol=0.02)
    torch.testing.assert_close(ground.colors[0].tolist(), [0.2, 0.7, 0.3], rtol=0, atol=0.05)


def test_noise_within_a_pixel_is_averaged_out():
    ground = ground_of(tilted_floor(2000, 0, noise=0.02))

    assert abs(ground.heights.item() - LEVEL) < 0.002


def test_there_is_no_ground_without_a_plane_without_normals_and_without_points():
    clutter = tilted_floor(0, 500)
    bare = Scenery(**{**vars(clutter), "normals": torch.zeros_like(clutter.normals)})
    none = Scenery(**{**vars(clutter), "mask": clutter.mask & False})
    rays, beyond = looking(random(20, 3)), random(1, 20, 3)
    for seen in (clutter, bare, none):
        assert not ground_of(seen).found.any()
        colors, ground = guess()(seen, rays, beyond)
        assert torch.equal(colors, beyond) and not ground.any()


def test_members_of_a_batch_have_grounds_of_their_own():
    one, other = tilted_floor(600, 400), tilted_floor(600, 400, noise=0.02)
    other = Scenery(**{**vars(other), "positions": other.positions + torch.tensor([0.0, 0.0, 1.0]).double()})
    both = Scenery(**{name: torch.cat([getattr(part, name) for part in (one, other)]) for name in vars(one)})

    together = ground_of(both)

    for member, alone in enumerate((one, other)):
        for name, found in zip(Ground._fields, ground_of(alone), strict=True):
            torch.testing.assert_close(getattr(together, name)[member], found[0], rtol=0, atol=1e-12, msg=name)


def test_what_the_mask_leaves_out_may_hold_anything():
    seen = tilted_floor()
    left_out = torch.arange(seen.mask.shape[1]) % 3 == 0
    junk = {
        name: torch.where(left_out.view(1, -1, *[1] * (value.dim() - 2)), torch.nan, value)
        for name, value in vars(seen).items()
        if name in ("positions", "normals", "views", "colors", "sizes")
    }
    masked = {**vars(seen), "mask": seen.mask & ~left_out}

    for one, other in zip(ground_of(Scenery(**masked)), ground_of(Scenery(**masked | junk)), strict=True):
        assert torch.equal(one, other) and torch.isfinite(one).all()


def test_the_ground_is_sure_as_far_out_as_it_was_seen():
    inside, outside = on_plane(random(20, 3) - 0.5), on_plane(UP + 3 + 4 * random(20, 3))
    _, ground = guess()(tilted_floor(), looking(torch.cat([inside, outside])), random(1, 40, 3))

    assert ground[0, :20].min() > 0.9 and not ground[0, 20:].any()


def test_before_training_the_floor_goes_on_in_its_colour_and_ends_at_its_horizon():
    seen = tilted_floor()
    below = on_plane(40 * random(50, 3, seed=5) - 20)
    above = CAMERA + below - 2 * ((below @ UP) - LEVEL)[:, None] * UP  # mirrored: no ray to it meets the floor
    above = above + 3 * UP
    for targets, is_floor in ((below, True), (above, False)):
        rays = looking(targets)
        facing = (rays.directions @ UP)[0]
        beyond = torch.zeros(1, 50, 3, dtype=torch.float64)
        colors = guess()(seen, rays, beyond)[0][0]
        if is_floor:
            steep = facing < -0.06
            assert steep.sum() > 10
            assert (colors[steep] - ground_of(seen).colors).abs().max() < 1e-9
        else:
            assert torch.equal(colors[facing > 0.02], beyond[0][facing > 0.02]) and (facing > 0.02).sum() > 10


def test_what_one_camera_teaches_about_a_place_another_shows_and_a_direction_alone_cannot():
    """Stripes on the floor, learned from two cameras, drawn from a third."""
    seen = tilted_floor()

    def stripes(points):
        return torch.where(torch.sin(3 * points[:, :1]) > 0, 0.8, 0.2).expand(-1, 3).double()

    def view(origin, seed):
        points = on_plane(4 * random(400, 3, seed=seed) - 2)
        return looking(points, torch.tensor(origin, dtype=torch.float64)), stripes(points)

    taught = [view([0.0, -3.0, 2.0], 6), view([2.5, 2.0, 2.5], 7)]
    torch.manual_seed(0)
    by_place, by_direction = guess(), Background(frequencies=3, hidden_dim=64).double()
    dark = torch.zeros(1, 400, 3, dtype=torch.float64)

    def drawn(model, rays):
        return (model(seen, rays, dark)[0] if model is by_place else model(rays.directions))[0]

    errors = []
    for model in (by_place, by_direction):
        optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
        for _ in range(150):
            optimizer.zero_grad()
            sum((drawn(model, rays) - colors).square().mean() for rays, colors in taught).backward()
            optimizer.step()
        rays, colors = view([-2.5, 1.0, 2.0], 8)
        with torch.no_grad():
            errors.append((drawn(model, rays) - colors).square().mean().item())

    assert errors[0] < 0.03 and errors[1] > 0.09  # one colour for all: 0.09


def test_gradients_match_finite_differences():
    model, seen, rays = guess(hidden_dim=4, frequencies=1), tilted_floor(60, 20), looking(on_plane(random(5, 3)))
    torch.nn.init.normal_(model.network[-1].weight, generator=torch.Generator().manual_seed(0))
    weights = dict(model.named_parameters())

    def draw(beyond, *values):
        given = dict(zip(weights, values, strict=True))
        return torch.func.functional_call(model, given, (seen, rays, beyond))[0]

    assert torch.autograd.gradcheck(draw, (random(1, 5, 3).requires_grad_(), *weights.values()))


def test_far_away_and_at_the_horizon_everything_is_finite():
    seen = tilted_floor()
    directions = normalize(torch.cat([random(200, 2, seed=9) - 0.5, torch.zeros(200, 1).double()], dim=1), dim=-1)
    directions = normalize(directions - (directions @ UP)[:, None] * UP, dim=-1)  # level: along the floor
    tilt = torch.logspace(-14, 0, 200, dtype=torch.float64)[:, None] * UP
    for dtype in (torch.float64, torch.float32):
        model = guess().to(dtype)
        for sign in (-1, 0, 1):
            level = normalize(directions + sign * tilt, dim=-1)
            rays = Rays(CAMERA.expand_as(level)[None], level[None]).to(dtype)
            colors, _ = model(seen.to(dtype), rays, torch.zeros(1, 200, 3, dtype=dtype))
            colors.sum().backward()
            assert torch.isfinite(colors).all()
            assert all(torch.isfinite(weight.grad).all() for weight in model.parameters())


def test_a_renderer_draws_the_seen_as_before_and_the_ground_in_the_gap():
    floor = tilted_floor(4000, 0)
    hidden = floor.positions[..., 0] > 0.5
    floor = Scenery(**{**vars(floor), "mask": floor.mask & ~hidden})
    body = torch.zeros(1, 1, 3, dtype=torch.float64)
    particles = Particles(
        body + 50, torch.zeros(1, 1, 5, dtype=torch.float64), moving=torch.ones(1, 1, dtype=torch.bool), scenery=floor
    )
    torch.manual_seed(0)
    plain, going_on = renderer(num_lights=0), renderer(num_lights=0, unseen_ground=True)
    going_on.load_state_dict(plain.state_dict(), strict=False)
    here = looking(on_plane(torch.tensor([[-1.0, 0.0, 0.0], [-0.5, 0.5, 0.0]], dtype=torch.float64)))
    there = looking(on_plane(torch.tensor([[1.5, 0.0, 0.0], [1.2, 0.5, 0.0]], dtype=torch.float64)))

    torch.testing.assert_close(
        going_on(particles, here, None).rgbs, plain(particles, here, None).rgbs, rtol=0, atol=1e-3
    )
    gap = going_on(particles, there, None)
    assert (gap.rgbs[0] - ground_of(floor).colors).abs().max() < 1e-3
    assert (plain(particles, there, None).rgbs - gap.rgbs).abs().max() > 0.05
    assert math.isclose(gap.opacities.max().item(), 0, abs_tol=1e-3)  # a guess is no surface
