import math
from dataclasses import fields, replace

import pytest
import torch

from tests.renderer.test_splat import renderer as plain_renderer
from vpd_lightning.renderer.shadows import Shadows
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.types import Occluders, Particles, Rays, Scenery

GRAY, RED, GREEN = [0.4, 0.5, 0.6], [0.9, 0.1, 0.1], [0.1, 0.8, 0.2]
HEIGHT = 2.0
"""Of the camera above the floor (metres); it looks straight down."""


def renderer(**changes):
    return plain_renderer(
        **{
            "facing_softness": None,
            "has_scenery": True,
            "num_scenery_candidates": 12,
            "elliptic_footprints": True,
            "far_pixels": True,
            "seen_through": True,
            "unseen_ground": False,
            "num_lights": 1,
            "shadow_softness": 0.5,
            "candidate_backend": "torch",
            **changes,
        }
    )


def tensor(values):
    return torch.tensor(values, dtype=torch.float64)


def floor(height=0.0, color=GRAY, spacing=0.05, half_width=1.0, occluders=None):
    """A level floor of square pixels, as a camera far above it saw it."""
    axis = torch.arange(-half_width, half_width + spacing / 2, spacing, dtype=torch.float64)
    positions = torch.cartesian_prod(axis, axis, tensor([height]))[None]
    up = tensor([0.0, 0.0, 1.0]).expand_as(positions)
    occluders = positions[:, :0] if occluders is None else occluders
    return Scenery(
        positions=positions,
        colors=tensor(color).expand_as(positions),
        normals=up,
        views=-up,
        sizes=torch.full_like(positions[..., 0], spacing),
        mask=torch.ones_like(positions[..., 0], dtype=torch.bool),
        occluders=occluders,
        occluder_mask=torch.ones_like(occluders[..., 0], dtype=torch.bool),
    )


def ball(center, color=RED, count=40, seed=0):
    """Particles of a body that moves, in a cube of a decimetre."""
    generator = torch.Generator().manual_seed(seed)
    places = tensor(center) + 0.1 * (torch.rand(1, count, 3, generator=generator, dtype=torch.float64) - 0.5)
    features = torch.cat([tensor(color).expand(1, count, 3), torch.zeros(1, count, 2).double()], dim=-1)
    return Particles(places, features, moving=torch.ones(1, count, dtype=torch.bool))


def joined(*parts):
    names = ("positions", "features", "mask", "moving")
    return Particles(**{name: torch.cat([getattr(part, name) for part in parts], dim=1) for name in names})


def members(parts):
    return Scenery(**{item.name: torch.cat([getattr(part, item.name) for part in parts]) for item in fields(Scenery)})


def straight_down(places):
    origins = torch.cat([tensor(places), torch.full((len(places), 1), HEIGHT).double()], dim=-1)[None]
    return Rays(origins, tensor([0.0, 0.0, -1.0]).expand_as(origins))


BESIDE = [[-0.4, 0.0], [0.4, 0.0], [0.0, 0.45]]
"""Places on the floor that nothing of a ball in the middle hides."""

BALL = [0.0, 0.0, 0.4]


def with_side_light(model):
    """Turn the light so that a ball in the middle casts its shadow on the first place."""
    with torch.no_grad():
        model.shadows.directions.copy_(tensor([[1.0, 0.0, 1.0]]))
        model.shadows.shares.copy_(tensor([[0.3, 0.2, 0.1]]))
        model.shadows.log_softness.fill_(math.log(0.01))  # of a decimetre's body, its middle stays dark
    return model


def floor_only(model):
    """Make layers of particles transparent, so that the floor alone is seen, with its shadows."""
    with torch.no_grad():
        model.network[-1].weight[6:], model.network[-1].bias[6:] = 0, -40
    return model


def test_deleting_what_moves_takes_its_shadow_off_the_floor():
    body = ball(BALL)
    model, rays = floor_only(with_side_light(renderer())), straight_down(BESIDE)
    scene = replace(body, scenery=floor(occluders=body.positions))
    points = rays.origins * tensor([1.0, 1.0, 0.0])
    light = model.shadows(points, body.positions, body.mask)

    there = model(scene, rays, None)
    gone = model(replace(scene, mask=scene.mask & False), rays, None)

    assert light[0, 0, 0] < 0.75 and light[0, 1:].min() > 0.98
    torch.testing.assert_close(there.rgbs[0, 0], tensor(GRAY), rtol=0, atol=1e-6)  # as observed, with its shadow
    torch.testing.assert_close(gone.rgbs, tensor(GRAY) / light, rtol=0, atol=1e-6)
    torch.testing.assert_close(gone.depths, torch.full_like(gone.depths, HEIGHT), rtol=0, atol=1e-6)
    assert gone.opacities.min() > 0.99


def test_a_shadow_moves_with_its_body():
    body = ball(BALL)
    model, rays = floor_only(with_side_light(renderer())), straight_down([*BESIDE, [-0.4, 0.45]])
    scene = replace(body, scenery=floor(occluders=body.positions))

    moved = replace(scene, positions=scene.positions + tensor([0.0, 0.45, 0.0]))

    light = (model(moved, rays, None).rgbs / tensor(GRAY))[0]
    assert (light[0] > 1.05).all()  # freed of its shadow
    assert (light[3] < 0.95).all()  # newly in it
    assert (light[1] - 1).abs().max() < 0.01


def test_scenery_is_ignored_where_it_is_not_asked_for():
    model, rays, body = renderer(has_scenery=False, num_lights=0), straight_down(BESIDE), ball(BALL)
    scene = joined(body, replace(ball([0.4, 0.0, 0.0], GREEN), moving=torch.zeros(1, 40, dtype=torch.bool)))

    with_it, without = model(replace(scene, scenery=floor()), rays, None), model(scene, rays, None)

    for name in ("rgbs", "depths", "opacities"):
        assert torch.equal(getattr(with_it, name), getattr(without, name))
    assert without.opacities[0, 1] > 0.5  # what stands still is drawn as particles


def test_what_stands_still_is_drawn_by_the_scenery_alone():
    model, rays, body = renderer(), straight_down([[0.0, 0.0], *BESIDE]), ball(BALL)
    post = replace(ball([0.4, 0.0, 0.3], GREEN), moving=torch.zeros(1, 40, dtype=torch.bool))

    both = model(replace(joined(post, body), scenery=floor()), rays, None)
    alone = model(replace(body, scenery=floor()), rays, None)
    bare = model(joined(post, body), rays, None)

    for name in ("rgbs", "depths", "opacities"):
        torch.testing.assert_close(getattr(both, name), getattr(alone, name), rtol=0, atol=1e-9)
    assert (bare.rgbs - both.rgbs)[0, 2].abs().max() > 0.1


def two_members(num_steps):
    """Two floors, and a body above each that is somewhere else in every step."""
    bodies = [ball(BALL, RED, seed=0), ball([0.1, -0.1, 0.3], GREEN, seed=1)]
    floors = [
        floor(color=GRAY, occluders=bodies[0].positions),
        floor(0.1, [0.7, 0.6, 0.2], occluders=bodies[1].positions),
    ]
    shifts = [tensor([0.1 * step, 0.05 * step, 0.0]) for step in range(num_steps)]
    states = [[replace(body, positions=body.positions + shift) for shift in shifts] for body in bodies]
    return states, floors


def test_steps_of_a_clip_share_its_scenery_and_no_other():
    model = with_side_light(renderer(ray_chunk_size=2))
    states, floors = two_members(num_steps=3)
    flat = [state for member in states for state in member]
    rays = [straight_down([[0.1 * i, 0.02 * i], *BESIDE]) for i in range(6)]
    names = ("positions", "features", "mask", "moving")
    together = Particles(
        **{name: torch.cat([getattr(s, name) for s in flat]) for name in names}, scenery=members(floors)
    )
    lines = Rays(torch.cat([r.origins for r in rays]), torch.cat([r.directions for r in rays]))

    out = model(together, lines, None)

    for i, state in enumerate(flat):
        alone = model(replace(state, scenery=floors[i // 3]), rays[i], None)
        for name in ("rgbs", "depths", "opacities"):
            torch.testing.assert_close(getattr(out, name)[i], getattr(alone, name)[0], rtol=0, atol=1e-9)


def test_scenery_in_front_hides_a_body_and_a_body_in_front_hides_scenery():
    model, rays, body = renderer(num_lights=0), straight_down([[0.0, 0.0]]), ball(BALL)

    under_a_roof = model(replace(body, scenery=floor(1.0)), rays, None)
    above_the_floor = model(replace(body, scenery=floor(0.0)), rays, None)

    torch.testing.assert_close(under_a_roof.rgbs[0, 0], tensor(GRAY), rtol=0, atol=1e-3)
    assert under_a_roof.depths.item() == pytest.approx(1.0, abs=1e-3)
    torch.testing.assert_close(above_the_floor.rgbs[0, 0], 0.8 * tensor(RED) + 0.2 * tensor(GRAY), rtol=0, atol=0.15)
    assert above_the_floor.depths.item() < 1.75
    assert above_the_floor.opacities.item() > 0.999


def test_a_body_that_stands_on_the_floor_is_not_hidden_by_it():
    model, rays = renderer(num_lights=0), straight_down([[0.0, 0.0]])
    flat = replace(ball([0.0, 0.0, 0.0]), positions=ball([0.0, 0.0, 0.0]).positions * tensor([1.0, 1.0, 0.0]))

    out = model(replace(flat, scenery=floor()), rays, None)
    bare = model(flat, rays, None)

    share = (out.rgbs - tensor(GRAY))[..., 0] / (tensor(RED) - tensor(GRAY))[0]
    assert share.item() > 0.95 * bare.opacities.item()


def test_beyond_the_scenery_the_background_shows():
    model, rays = renderer(num_lights=0), straight_down([[1.4, 0.0], [0.0, -1.5]])
    body = ball(BALL)

    out = model(replace(body, mask=body.mask & False, scenery=floor()), rays, None)

    behind = model.background(rays.directions)
    torch.testing.assert_close(out.rgbs, behind, rtol=0, atol=1e-4)
    assert out.opacities.max() < 1e-4 and (out.depths - model.far).abs().max() < 1e-3


def test_a_particle_that_faces_away_does_not_shine_through():
    """A red face towards the camera, a green one turned away so near to it that both are in the front layer."""
    front, back = ball(BALL, RED, seed=1), ball(BALL, GREEN, seed=2)
    faces = joined(front, back)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(front.positions)
    normals = torch.cat([up, -up], dim=1)
    plain, facing = renderer(num_candidates=80), renderer(num_candidates=80, facing_softness=0.1)
    facing.load_state_dict(plain.state_dict())
    rays = straight_down([[0.0, 0.0], [0.02, 0.01]])

    def shown(model, normals):
        out = model(replace(faces, normals=normals), rays, None)
        left = (1 - out.opacities)[..., None] * model.background(rays.directions)
        return (out.rgbs - left) / out.opacities[..., None]

    assert (shown(facing, normals) - tensor(RED)).abs().max() < 0.01
    assert (shown(plain, normals) - tensor(RED)).abs().max() > 0.1
    torch.testing.assert_close(shown(facing, torch.zeros_like(normals)), shown(plain, normals), rtol=0, atol=1e-9)
    torch.testing.assert_close(shown(facing, None), shown(plain, None), rtol=0, atol=1e-9)
    assert (shown(facing, -normals) - tensor(GREEN)).abs().max() < 0.01


def test_colours_stay_in_range_where_a_shadow_goes_from_a_bright_floor():
    body = ball(BALL)
    model, rays = floor_only(with_side_light(renderer())), straight_down(BESIDE)
    scene = replace(body, mask=body.mask & False, scenery=floor(color=[0.95] * 3, occluders=body.positions))

    rgbs = model(scene, rays, None).rgbs

    assert rgbs.min() >= 0 and rgbs.max() <= 1


def test_a_renderer_reads_as_many_occluders_as_it_says():
    body, rays = ball(BALL), straight_down(BESIDE)
    lit = {}
    for count in (5, 40, 400):
        model = floor_only(with_side_light(renderer(num_occluders=count)))
        lit[count] = model(replace(body, scenery=floor()), rays, None).rgbs
    torch.testing.assert_close(lit[40], lit[400], rtol=0, atol=1e-5)
    assert not torch.allclose(lit[5], lit[40], atol=1e-3)


def test_occluders_that_particles_bring_cast_in_place_of_the_moving_ones():
    model, rays = floor_only(with_side_light(renderer())), straight_down(BESIDE)
    body, far_away = ball(BALL), ball([0.0, -0.7, 0.4])
    seen = Occluders(body.positions, body.mask)

    predicted_there = model(replace(body, scenery=floor()), rays, None).rgbs
    seen_there = model(replace(far_away, scenery=floor(), occluders=seen), rays, None).rgbs
    nowhere = model(replace(body, scenery=floor(), occluders=Occluders(seen.positions, ~seen.mask)), rays, None).rgbs

    torch.testing.assert_close(seen_there, predicted_there, rtol=0, atol=1e-9)
    assert (predicted_there[0, 0] < 0.95 * tensor(GRAY)).all() and (nowhere[0, 0] > 0.99 * tensor(GRAY)).all()


def test_a_body_that_was_added_last_casts_a_shadow_as_well():
    """Edits append: the first particles are then not a random choice of them all."""
    model, rays = floor_only(with_side_light(renderer())), straight_down(BESIDE)
    far_away = ball([0.0, -0.7, 0.4], count=300)

    only, last = (replace(scene, scenery=floor()) for scene in (ball(BALL), joined(far_away, ball(BALL, count=300))))

    assert (model(only, rays, None).rgbs[0, 0] < 0.95 * tensor(GRAY)).all()
    assert (model(last, rays, None).rgbs[0, 0] < 0.95 * tensor(GRAY)).all()


def test_what_is_kept_between_steps_does_not_outlive_its_scene_or_weights():
    """Without gradients the scenery along the same rays is kept for the next step."""
    model, body, rays = floor_only(with_side_light(renderer())), ball(BALL), straight_down(BESIDE)
    scene = replace(body, scenery=floor(occluders=body.positions))
    gone = replace(scene, mask=scene.mask & False)
    other, elsewhere = replace(scene, scenery=floor(0.2, GREEN)), straight_down([[0.1, 0.2], [0.5, 0.5]])

    with torch.no_grad():
        steps = [(scene, rays), (gone, rays), (other, rays), (scene, elsewhere), (scene, rays)]
        kept = [model(some, lines, None) for some, lines in steps]
        model.shadows.shares.mul_(0.5)
        dimmer = model(gone, rays, None)

    model.shadows.shares.detach().mul_(2.0)
    for (some, lines), out in zip(steps, kept, strict=True):  # with gradients nothing is kept
        for name in ("rgbs", "depths", "opacities"):
            torch.testing.assert_close(getattr(out, name), getattr(model(some, lines, None), name).detach())
    assert (kept[1].rgbs - dimmer.rgbs)[0, 0].abs().max() > 0.01


def test_rays_that_were_overwritten_in_place_are_looked_along_anew():
    model, body, rays = renderer(), ball(BALL), straight_down(BESIDE)
    scene = replace(body, scenery=floor())

    with torch.no_grad():
        model(scene, rays, None)
        rays.origins[..., 0] += 5.0  # past the edge of the floor
        out = model(scene, rays, None)

    assert out.opacities.max() < 0.01


def test_before_training_a_ray_passes_beside_a_body_and_not_through_it():
    model, rays = renderer(num_lights=0), straight_down([[0.0, 0.0], *BESIDE])

    rgbs = model(replace(ball(BALL, count=200), scenery=floor()), rays, None).rgbs[0]

    assert (rgbs[0] - tensor(RED)).abs().max() < 0.1
    assert (rgbs[1:] - tensor(GRAY)).abs().max() < 1e-3


def test_no_rays_and_no_particles_are_no_error():
    model, body = renderer(), replace(ball(BALL), scenery=floor())
    rays = straight_down(BESIDE)

    empty = Particles(
        body.positions[:, :0], body.features[:, :0], moving=body.moving[:, :0], scenery=floor(occluders=body.positions)
    )
    assert model(empty, rays, None).rgbs.shape == (1, 3, 3)
    none = model(body, Rays(rays.origins[:, :0], rays.directions[:, :0]), None)
    assert none.rgbs.shape == (1, 0, 3) and none.depths.shape == (1, 0)


def test_gradients_reach_shadows_scenery_and_what_moves_and_are_finite():
    model, rays = with_side_light(renderer(facing_softness=0.1)), straight_down([[0.0, 0.0], *BESIDE, [1.6, 0.0]])
    states, floors = two_members(num_steps=2)
    names = ("positions", "features", "mask", "moving")
    flat = [state for member in states for state in member]
    parts = {name: torch.cat([getattr(s, name) for s in flat]) for name in names}
    parts["moving"] = torch.arange(40).expand(4, 40) < 30
    for name in ("positions", "features"):
        parts[name].requires_grad_()
    rays = Rays(rays.origins.expand(4, -1, -1), rays.directions.expand(4, -1, -1))

    out = model(Particles(**parts, scenery=members(floors)), rays, None)
    (out.rgbs.square().sum() + out.depths.sum()).backward()

    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
    for name in ("shadows.directions", "shadows.shares", "shadows.log_softness", "scenery.log_width"):
        assert model.get_parameter(name).grad.abs().sum() > 0, name
    for name in ("positions", "features"):
        gradient = parts[name].grad
        assert torch.isfinite(gradient).all()
        assert gradient[:, :30].abs().sum() > 0 and not gradient[:, 30:].any()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"facing_softness": 0.0}, "facing_softness must be positive or null"),
        ({"facing_softness": -1.0}, "facing_softness must be positive or null"),
        ({"num_lights": -1}, "num_lights must be at least 0"),
        ({"num_scenery_candidates": 0}, "num_scenery_candidates at least 1"),
        ({"num_occluders": 0}, "num_occluders from 1 to 2048"),
        ({"num_occluders": 2049}, "num_occluders from 1 to 2048"),
        ({"has_scenery": False}, "num_lights=1 cast shadows on the scenery"),
        ({"shadow_softness": 0.0}, "softness positive"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, words):
    with pytest.raises(ValueError, match=words):
        renderer(**changes)


def test_parts_that_are_not_asked_for_hold_no_weights():
    without, unlit = renderer(has_scenery=False, num_lights=0), renderer(num_lights=0)

    assert without.scenery is None and without.shadows is None and unlit.shadows is None
    assert isinstance(renderer().shadows, Shadows) and isinstance(unlit, SplatRenderer)
    assert {name for name in unlit.state_dict() if name not in without.state_dict()} == {
        "scenery.log_width",
        "scenery.log_angle",
    }
