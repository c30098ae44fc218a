import math
from dataclasses import replace

import pytest
import torch

from tests.dynamics.test_rigid_motion import cube, random_toss, rotation_about
from vpd_lightning.dynamics.inertial import InertialDynamics
from vpd_lightning.dynamics.rigid_motion import rotation_from_spin
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles

SETTINGS = {
    "feature_dim": 4,
    "hidden_dim": 16,
    "num_anchors": 3,
    "anchor_radius": 0.5,
    "body_radius": 2.0,
    "num_probes": 32,
    "message_passing_steps": 2,
    "num_forces": 2,
    "location_scale": 0.3,
    "contact_range": 0.5,
    "contact_reach": 5.0,
    "num_contact_iterations": 4,
    "max_contact_depth": 0.06,
    "match_scales": [0.12, 0.07, 0.04, 0.025, 0.015],
    "match_color_scale": 0.05,
    "match_radius": 0.3,
    "num_matched": 120,
    "shadow_scales": [0.1, 0.4],
}


def dynamics(**changes):
    return InertialDynamics(**{**SETTINGS, **changes}).double()


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


def tossed(seed=0):
    previous, previous_colors, current, colors, _ = random_toss(seed)
    normals = cube(200, seed=30 + seed)[2]
    return (
        scene(previous, previous_colors, torch.zeros_like(previous)),
        scene(current, colors, normals),
    )


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


def test_a_free_spinning_cube_is_followed_around_its_true_centre():
    points, colors, normals = cube(200, seed=4)
    spin = torch.tensor([0.2, -0.1, 0.25], dtype=torch.float64)
    turn, shift = rotation_from_spin(spin), torch.tensor([0.03, 0.0, -0.02], dtype=torch.float64)
    model = dynamics(num_matched=200)
    torch.nn.init.constant_(model.forces.damping.bias, 30.0)  # no damping at all
    previous = scene(points, colors, normals)
    current = scene(points @ turn.T + shift, colors, normals @ turn.T)
    keys = RandomKeys.fixed(1)
    memory = model.initialize(previous, current, keys)
    true_displacement = (points @ turn.T + shift) - points
    memory = replace(memory, displacements=true_displacement[memory.index], center_displacements=shift.expand(1, 3, 3))

    errors = []
    for step in range(8):
        current, memory = model(previous, current, memory, keys, step)
        power = torch.linalg.matrix_power(turn, step + 2)
        true = points @ power.T + (step + 2) * shift
        true[:, 2] += 0.8
        errors.append((current.positions[0, :200] - true).norm(dim=-1).mean())

    assert errors[-1] < 0.012  # of a body 30 cm wide that turned by 150 degrees


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
    points, colors, normals = cube(300, seed=5)
    turn = rotation_about([0, 1, 0], angle)
    now = scene(points @ turn.T, colors, normals @ turn.T, height=height, num_floor=400)
    before = scene(points @ turn.T, colors, normals @ turn.T, height=height + speed, num_floor=400)
    model = dynamics(num_anchors=1, num_probes=300, num_matched=300, **changes)
    with torch.no_grad():  # gravity of 2.5 cm a step, as 9.81 m/s^2 at 20 frames/s
        model.forces.weight.bias[2] = -math.atanh(0.0245 / SETTINGS["location_scale"])
    return roll(model, before, now, steps), now


def test_a_falling_body_stops_on_the_floor_and_stays_there():
    states, now = falling(height=0.35, speed=0.06, angle=0.0, steps=40)
    body = now.moving[0]

    lowest = torch.stack([state.positions[0, body, 2].min() for state in states])
    assert lowest.min() > -0.01
    heights = states[-1].positions[0, body, 2]
    assert 0.27 < heights.max() < 0.33  # a cube of 30 cm on one of its faces
    assert (states[-1].positions - states[-5].positions).norm(dim=-1).max() < 0.02


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


def test_friction_and_inertia_are_learned_from_a_body_that_strikes_and_slides():
    points, colors, normals = cube(300, seed=5)
    turn = rotation_about([0, 1, 0], 0.3)
    aside = torch.tensor([0.05, 0.0, 0.0], dtype=torch.float64)
    model = dynamics(num_anchors=1, num_probes=300, num_matched=300)
    now = scene(points @ turn.T, colors, normals @ turn.T, height=0.25, num_floor=400)
    before = scene(points @ turn.T - aside, colors, normals @ turn.T, height=0.30, num_floor=400)

    roll(model, before, now, 3)[-1].positions.square().sum().backward()

    assert model.log_friction.grad.abs() > 0 and model.log_inertia_ratio.grad.abs() > 0


def test_every_parameter_receives_a_finite_gradient():
    previous, current = tossed()
    model = dynamics()
    torch.nn.init.normal_(model.forces.force.weight, std=0.1)
    torch.nn.init.normal_(model.forces.damping.weight, std=0.1)

    states = roll(model, previous, current, 3)
    (states[-1].positions.square().sum() + states[-1].features.square().sum()).backward()

    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name


def test_autocast_leaves_the_geometry_alone():
    previous, current = (particles.to(torch.float32) for particles in tossed())
    model = InertialDynamics(**SETTINGS)
    expected = model.initialize(previous, current, RandomKeys.fixed(1))

    with torch.autocast("cpu", dtype=torch.bfloat16):
        memory = model.initialize(previous, current, RandomKeys.fixed(1))

    for name, value in vars(expected).items():
        assert torch.equal(getattr(memory, name), value), name


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


@pytest.mark.parametrize("changes", [{"num_anchors": 0}, {"anchor_radius": 0.0}, {"shadow_scales": [0.0]}])
def test_wrong_settings_are_refused(changes):
    with pytest.raises(ValueError):
        dynamics(**changes)
