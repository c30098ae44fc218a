import math
from dataclasses import replace

import pytest
import torch

from tests.dynamics.solids import ball, cube, random_rotation, rotation_about
from vpd_lightning.dynamics.inertial import InertialDynamics
from vpd_lightning.dynamics.inertial.first_velocity import FirstVelocity
from vpd_lightning.dynamics.inertial.rigid_motion import rotation_from_spin
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.testing.contract import tensors_of
from vpd_lightning.types import Particles

SETTINGS = {
    "feature_dim": 4,
    "hidden_dim": 16,
    "num_bodies": 3,
    "body_link": 1.7,
    "max_concavity": 0.15,
    "max_concave_share": 0.35,
    "num_probes": 32,
    "message_passing_steps": 2,
    "num_forces": 2,
    "location_scale": 0.3,
    "force_scale": 0.1,
    "residual_share": 0.1,
    "acceleration_gain": 1.0,
    "force_reach": None,
    "contact_range": 0.5,
    "contact_reach": 5.0,
    "num_contact_iterations": 4,
    "num_contact_substeps": None,
    "max_contact_depth": 0.06,
    "mirror_hidden": True,
    "is_soft": False,
    "max_friction": None,
    "infers_guided": False,
    "rest_share": 0.05,
    "keep_shape": True,
    "carry_memory": True,
    "shadow_scales": [0.1, 0.4],
    "extent_weight": 0.0,
    "guess_hidden": False,
    "has_driven": False,
    "edge_reach": None,
    "workspace_min": None,
    "workspace_max": None,
    "supported_speed": 0.0,
    "round_contact": False,
    "is_damped": True,
    "skip_resting": False,
}
FIRST_VELOCITY = {
    "match_scales": [0.8, 0.5, 0.3, 0.18, 0.12, 0.08],
    "min_scale": 0.3,
    "color_scale": 0.05,
    "feature_scale": None,
    "num_matched": 120,
    "num_plane_rounds": 3,
    "tangential_weight": 0.05,
    "rest_weight": 0.03,
    "picture_weight": 3.0,
}
GRAVITY = 0.0245  # metres a step squared: 9.81 m/s^2 at 20 frames/s


def dynamics(**changes):
    return InertialDynamics(**{**SETTINGS, "first_velocity": FirstVelocity(**FIRST_VELOCITY), **changes}).double()


def fall(model):
    """Let the model's forces be weight alone."""
    with torch.no_grad():
        model.forces.acceleration[2] = -math.atanh(GRAVITY / SETTINGS["force_scale"])
    return model


def floor(count, seed=9):
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(count, 3, generator=generator, dtype=torch.float64) * 2 - 1
    positions[:, 2] = 0
    return positions


def scene(body, body_colors, body_normals, height=0.8, num_floor=50):
    """A body above a floor; the floor is no candidate for motion."""
    ground = floor(num_floor)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    positions = torch.cat([body + height * up, ground])
    generator = torch.Generator().manual_seed(0)
    return Particles(
        positions=positions[None],
        features=torch.rand(1, len(positions), 4, generator=generator, dtype=torch.float64),
        colors=torch.cat([body_colors, torch.full_like(ground, 0.7)])[None],
        moving=(torch.arange(len(positions)) < len(body))[None],
        normals=torch.cat([body_normals, up.expand(num_floor, 3)])[None],
    )


def random_toss(seed):
    """A cube seen twice, by points drawn independently; also its spin and shift in between."""
    seen, seen_colors, seen_normals = cube(400, seed=10 + seed)
    points, colors, normals = cube(200, seed=30 + seed)
    start = random_rotation(seed)
    generator = torch.Generator().manual_seed(seed)
    spin = (torch.rand(3, generator=generator, dtype=torch.float64) * 2 - 1) * 0.3  # up to 6 rad/s at 20 frames/s
    shift = (torch.rand(3, generator=generator, dtype=torch.float64) * 2 - 1) * 0.05
    turn = rotation_from_spin(spin)
    before = seen @ start.T, seen_colors, seen_normals @ start.T
    return before, (points @ (turn @ start).T + shift, colors, normals @ (turn @ start).T), (start, turn, shift, points)


def tossed(seed=0):
    before, now, _ = random_toss(seed)
    return scene(*before), scene(*now)


def pairwise(points):
    return (points[:, None] - points).norm(dim=-1)


def roll(model, previous, current, num_steps):
    keys = RandomKeys.fixed(len(current.positions))
    memory, states = model.initialize(previous, current, keys), []
    for step in range(num_steps):
        following, memory = model(previous, current, memory, keys, step)
        previous, current = current, following
        states.append(following)
    return states


def test_untrained_it_continues_the_motion_and_keeps_the_body_rigid():
    previous, current = tossed()
    states = roll(dynamics(), previous, current, 6)

    body = current.moving[0]
    start = pairwise(current.positions[0, body])
    for state in states:
        assert torch.allclose(pairwise(state.positions[0, body]), start, atol=1e-3)
    centers = torch.stack([state.positions[0, body].mean(0) for state in states])
    assert (centers[1:] - centers[:-1]).norm(dim=-1).min() > 0.005


@pytest.mark.parametrize("seed", range(3))
def test_a_tossed_cube_flies_on_as_it_came(seed):
    before, now, (start, turn, shift, points) = random_toss(seed)
    model = dynamics()
    torch.nn.init.constant_(model.forces.damping.bias, 30.0)  # no damping at all

    states = roll(model, scene(*before), scene(*now), 8)

    # A point of the body at step n is at turn^(n + 1) (start x) + (n + 1) shift: turned about the true centre.
    power = torch.linalg.matrix_power(turn, 9)
    true = points @ (power @ start).T + 9 * shift
    true[:, 2] += 0.8
    error = (states[-1].positions[0, :200] - true).norm(dim=-1).mean()
    # of a body 30 cm wide that went up to 45 cm and turned by up to 150 degrees; its centre is known to a centimetre
    assert error < 0.03


def test_a_body_that_was_not_seen_before_starts_at_rest():
    _, now, _ = random_toss(0)
    current = scene(*now)
    elsewhere = replace(current, positions=current.positions + torch.tensor([30.0, 0.0, 0.0]).double())

    states = roll(dynamics(), elsewhere, current, 3)

    assert (states[-1].positions - current.positions).norm(dim=-1).max() < 1e-3


def test_without_a_first_velocity_bodies_start_at_rest():
    previous, current = tossed()

    states = roll(dynamics(first_velocity=None), previous, current, 3)

    assert torch.allclose(states[-1].positions, current.positions, atol=1e-12)


def test_without_rigidity_a_spinning_body_flies_apart_and_its_middle_goes_on():
    previous, current = tossed()
    body = current.moving[0]

    rigid, loose = (roll(dynamics(keep_shape=keep), previous, current, 6) for keep in (True, False))

    # Each particle keeps to its line, as a tangent leaves its circle; damping takes 0.7 % of its speed a step.
    first, last = ((state.positions - current.positions)[0, body] for state in (loose[0], loose[-1]))
    assert (last - 6 * first).norm(dim=-1).max() < 0.05 * last.norm(dim=-1).max()
    size = [pairwise(states[-1].positions[0, body]).mean() for states in ([current], rigid, loose)]
    assert abs(size[1] / size[0] - 1) < 1e-9 and size[2] / size[0] > 1.02
    apart = (loose[-1].positions - rigid[-1].positions)[0, body].mean(dim=0)
    assert apart.norm() < 0.2 * (rigid[-1].positions - current.positions)[0, body].mean(dim=0).norm()


def test_without_carried_memory_the_velocity_is_found_again_from_what_was_predicted():
    previous, current = tossed()
    body = current.moving[0]
    carried, found = (roll(dynamics(carry_memory=keep), previous, current, 5) for keep in (True, False))

    assert torch.equal(found[0].positions, carried[0].positions)
    assert not torch.equal(found[1].positions, carried[1].positions)
    moved = (carried[-1].positions - current.positions)[0, body].mean(dim=0)
    # Free flight without forces: the estimate from two predicted frames, whose points are the same, is nearly exact.
    assert ((found[-1].positions - carried[-1].positions)[0, body].mean(dim=0)).norm() < 0.1 * moved.norm()

    standing = list(current.positions[0, ~body])
    assert torch.equal(found[-1].positions[0, ~body], torch.stack(standing))


def test_what_is_no_candidate_stays_exactly_where_it_is():
    previous, current = tossed()
    model = dynamics()
    torch.nn.init.normal_(model.forces.force.weight)

    states = roll(model, previous, current, 20)

    still = ~current.moving[0]
    assert torch.equal(states[-1].positions[0, still], current.positions[0, still])
    assert torch.isfinite(states[-1].positions).all()


def test_a_body_at_rest_without_forces_stays_at_rest():
    points, colors, normals = cube(150, seed=2)
    still = scene(points, colors, normals, height=0.15)

    states = roll(dynamics(), still, still, 5)

    assert (states[-1].positions - still.positions).norm(dim=-1).max() < 0.01
    # shading follows the turn of a surface: hardly any turn, hardly any change
    assert (states[-1].features - still.features).abs().max() < 0.05


def falling(height, speed, angle, steps, **changes):
    """Roll a cube that moves down ``speed`` metres a step, turned by ``angle`` about y, from ``height``."""
    points, colors, normals = cube(150, seed=5)
    turn = rotation_about([0, 1, 0], angle)
    now = scene(points @ turn.T, colors, normals @ turn.T, height=height, num_floor=100)
    before = scene(points @ turn.T, colors, normals @ turn.T, height=height + speed, num_floor=100)
    model = fall(dynamics(num_probes=150, **changes))
    return roll(model, before, now, steps), now


def test_a_falling_body_stops_on_the_floor_and_stays_there():
    states, now = falling(height=0.35, speed=0.06, angle=0.0, steps=40)
    body = now.moving[0]

    lowest = torch.stack([state.positions[0, body, 2].min() for state in states])
    assert lowest.min() > -0.01
    heights = states[-1].positions[0, body, 2]
    assert 0.27 < heights.max() < 0.33  # a cube of 30 cm on one of its faces
    assert (states[-1].positions - states[-5].positions).norm(dim=-1).max() < 0.02


def resting_ball(num_steps, **changes):
    """The height of a ball of 30 cm that lies on the floor, under its weight, and how far its centre has crept."""
    points, colors, normals = ball(150, seed=2)
    now = scene(points, colors, normals, height=0.15, num_floor=100)
    with torch.no_grad():
        last = roll(fall(dynamics(num_probes=150, num_bodies=1, **changes)), now, now, num_steps)[-1]
    body = last.positions[0, now.moving[0]]
    return body[:, 2].max().item(), (body - now.positions[0, now.moving[0]]).norm(dim=-1).max().item()


def test_a_ball_at_rest_keeps_its_height_and_place():
    height, crept = resting_ball(30)

    assert height > 0.29 and crept < 0.02


def test_an_untrained_soft_ball_at_rest_is_nearly_rigid():
    height, _ = resting_ball(15, is_soft=True)

    assert height > 0.27


def test_a_tilted_body_is_turned_by_what_it_hits():
    states, now = falling(height=0.30, speed=0.05, angle=0.3, steps=6)
    body = now.moving[0]

    def heights(state):
        return state.positions[0, body, 2]

    assert torch.stack([heights(state).min() for state in states]).min() > -0.01
    turned = states[-1].positions[0, body] - now.positions[0, body]
    assert (turned[:, 2].max() - turned[:, 2].min()) > 0.02  # not a mere shift


def test_without_contact_iterations_a_body_falls_through_the_floor():
    states, now = falling(height=0.35, speed=0.06, angle=0.0, steps=12, num_contact_iterations=0)

    assert states[-1].positions[0, now.moving[0], 2].min() < -0.2


def test_moving_the_world_moves_the_prediction():
    previous, current = tossed()
    model = dynamics()
    torch.nn.init.normal_(model.forces.force.weight, std=0.1)
    shift = torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64)

    states = roll(model, previous, current, 3)
    moved = roll(
        model,
        replace(previous, positions=previous.positions + shift),
        replace(current, positions=current.positions + shift),
        3,
    )

    assert torch.allclose(moved[-1].positions, states[-1].positions + shift, atol=1e-6)
    assert torch.allclose(moved[-1].features, states[-1].features, atol=1e-6)


def test_a_batch_equals_its_members_whatever_their_padding():
    model = dynamics()
    torch.nn.init.normal_(model.forces.force.weight, std=0.1)
    full, shorter = (tossed(seed)[1] for seed in (0, 1))
    kept = torch.ones_like(shorter.mask)
    kept[0, 150:200] = False  # fewer candidates than its neighbour in the batch: its gathered set is padded
    shorter = replace(shorter, mask=kept, moving=shorter.moving & kept)
    names = ("positions", "features", "mask", "colors", "moving", "normals")
    both = Particles(**{name: torch.cat([getattr(full, name), getattr(shorter, name)]) for name in names})

    def rolled(particles):
        return roll(model, replace(particles, positions=particles.positions - 0.02), particles, 2)[-1].positions

    assert torch.allclose(rolled(both)[1, kept[0]], rolled(shorter)[0, kept[0]], atol=1e-8)


def test_friction_bounce_and_inertia_are_learned_from_a_body_that_strikes_and_slides():
    points, colors, normals = cube(300, seed=5)
    turn = rotation_about([0, 1, 0], 0.3)
    aside = torch.tensor([0.05, 0.0, 0.0], dtype=torch.float64)
    model = dynamics(num_probes=300, force_scale=0.01)  # what comes faster than 3 mm a step bounces
    now = scene(points @ turn.T, colors, normals @ turn.T, height=0.25, num_floor=400)
    before = scene(points @ turn.T - aside, colors, normals @ turn.T, height=0.30, num_floor=400)

    roll(model, before, now, 3)[-1].positions.square().sum().backward()

    friction, restitution = model.materials.network[-1].bias.grad[:2]
    assert friction.abs() > 0 and restitution.abs() > 0
    assert model.log_inertia_ratio.grad.abs() > 0


def test_every_parameter_receives_a_finite_gradient():
    previous, current = tossed()
    model = dynamics()
    torch.nn.init.normal_(model.forces.force.weight, std=0.1)
    torch.nn.init.normal_(model.forces.damping.weight, std=0.1)

    states = roll(model, previous, current, 3)
    (states[-1].positions.square().sum() + states[-1].features.square().sum()).backward()

    for name, parameter in model.named_parameters():
        # A rigid body has no use for stiffness and the like; those weights get a gradient of zero.
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name


def test_autocast_leaves_the_geometry_alone():
    previous, current = (particles.to(torch.float32) for particles in tossed())
    model = dynamics().float()
    expected = model.initialize(previous, current, RandomKeys.fixed(1))

    with torch.autocast("cpu", dtype=torch.bfloat16):
        memory = model.initialize(previous, current, RandomKeys.fixed(1))

    for (name, value), (_, other) in zip(tensors_of(expected), tensors_of(memory), strict=True):
        assert torch.equal(other, value), name


def test_features_of_the_first_frame_reach_the_prediction_with_their_gradient():
    previous, current = tossed()
    features = current.features.clone().requires_grad_()

    roll(dynamics(), previous, replace(current, features=features), 2)[-1].features.sum().backward()

    assert (features.grad.abs().sum(-1) > 0).all()


def test_a_scene_without_candidates_does_not_move():
    _, current = tossed()
    current = replace(current, moving=torch.zeros_like(current.moving))

    states = roll(dynamics(), current, current, 3)
    assert torch.equal(states[-1].positions, current.positions)
    assert torch.isfinite(states[-1].features).all()


def test_without_observed_normals_it_says_what_to_set():
    _, current = tossed()
    with pytest.raises(ValueError, match="use_normals"):
        dynamics().initialize(current, replace(current, normals=None), RandomKeys.fixed(1))


WRONG = [(name, 0) for name in ("num_bodies", "num_probes", "body_link", "force_scale", "edge_reach", "force_reach")]
WRONG += [("location_scale", -1.0), ("rest_share", -0.1), ("shadow_scales", [0.0]), ("supported_speed", -1.0)]


@pytest.mark.parametrize(("name", "value"), WRONG)
def test_wrong_settings_are_refused(name, value):
    with pytest.raises(ValueError, match=name.removeprefix("shadow_")):
        dynamics(**{name: value})
