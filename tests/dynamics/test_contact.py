"""Bodies and what stands still: impulses, bounces and slides against closed forms."""

from dataclasses import replace

import pytest
import torch

from tests.dynamics.contact_world import World
from tests.dynamics.solids import UP, even_ball, even_cube, rotation_about
from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, Inertia
from vpd_lightning.dynamics.inertial.contact import ContactSolver
from vpd_lightning.dynamics.inertial.contact_search import ContactPoints, Contacts, nearest_static_contacts
from vpd_lightning.dynamics.inertial.materials import Materials

EYE = torch.eye(3, dtype=torch.float64)


def floor(count=20):
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(1, count, 3, generator=generator, dtype=torch.float64) * 2 - 1
    positions[..., 2] = 0
    return positions, UP.expand(1, count, 3), torch.ones(1, count, dtype=torch.bool)


def test_distance_to_a_floor_is_the_height_however_far_apart_its_particles_are():
    probes = torch.tensor([[[0.1, 0.2, 0.3], [0.0, 0.0, -0.05], [-0.4, 0.3, 0.01]]], dtype=torch.float64)

    contacts = nearest_static_contacts(probes, *floor(), far=1.0)

    assert torch.allclose(contacts.distances, probes[..., 2], atol=1e-12)
    assert torch.allclose(contacts.normals, UP.expand(1, 3, 3))


def test_each_probe_is_held_against_its_nearest_particle_whose_normal_is_known():
    generator = torch.Generator().manual_seed(1)
    probes, positions, normals = torch.rand(3, 2, 40, 3, generator=generator, dtype=torch.float64)
    normals = normals / normals.norm(dim=-1, keepdim=True)
    normals[:, ::3] = 0.0
    mask = torch.rand(2, 40, generator=generator) < 0.8

    contacts = nearest_static_contacts(probes, positions, normals, mask, far=9.0)

    for member in range(2):
        usable = mask[member] & (normals[member].norm(dim=-1) > 0.5)
        for probe in range(40):
            offsets = probes[member, probe] - positions[member]
            nearest = offsets.norm(dim=-1).masked_fill(~usable, torch.inf).argmin()
            height = offsets[nearest] @ normals[member, nearest]
            lateral = (offsets[nearest] - height * normals[member, nearest]).norm()
            assert contacts.distances[member, probe].item() == pytest.approx(height.item(), abs=1e-12)
            assert contacts.lateral[member, probe].item() == pytest.approx(lateral.item(), abs=1e-6)


def test_nothing_near_nothing_static_and_unknown_normals_are_no_contact():
    probes = torch.zeros(1, 1, 3, dtype=torch.float64)
    positions, normals, mask = floor()

    for arguments in (
        (positions + 9, normals, mask),
        (positions, torch.zeros_like(normals), mask),
        (positions, normals, torch.zeros_like(mask)),
    ):
        contacts = nearest_static_contacts(probes, *arguments, far=1.0)
        assert contacts.distances.item() == 1.0 and (contacts.normals == 0).all()


POINTS = torch.tensor([[[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]], dtype=torch.float64)


def one(value, count=1):
    return torch.full((1, count, 1), value, dtype=torch.float64)


def resolve(
    distances, *, num_iterations=1, inverse_inertia=100.0, friction=0.0, restitution=0.0, velocity=(0, 0, -0.1)
):
    """Three points of a body around the origin that moves down, at given distances from a floor."""
    zero = torch.zeros(1, 1, 3, dtype=torch.float64)
    free = BodyMotion(zero, torch.tensor([[velocity]], dtype=torch.float64), zero, EYE[None, None], 0 * EYE[None, None])
    contacts = Contacts(
        torch.tensor([distances], dtype=torch.float64), UP.expand(1, 3, 3), torch.zeros(1, 3, dtype=torch.float64)
    )
    solver = ContactSolver(
        points=ContactPoints(POINTS, UP.expand(1, 3, 3), torch.ones(1, 1, 3, dtype=torch.float64)),
        centers=free.centers,
        inertia=Inertia(inverse_inertia * EYE[None, None], EYE[None, None], one(0.0)),
        materials=Materials(one(friction), one(restitution), one(1.0), one(0.0), one(0.25), one(0.1)),
        masses=one(1.0),
        rest_speed=1e-12,
    )
    return free, solver.resolve(free, contacts, None, num_iterations=num_iterations, max_depth=0.06)


def test_a_body_that_touches_nothing_moves_on_untouched():
    before, after = resolve([0.5, 0.5, 0.5], num_iterations=4)

    for motion in (after.step, after.onward):
        for name, value in vars(before).items():
            assert torch.equal(getattr(motion, name), value), name
    assert not after.touching.any()


def test_without_iterations_nothing_is_resolved():
    before, after = resolve([-0.02, 0.5, 0.5], num_iterations=0)

    assert torch.equal(after.step.displacements, before.displacements) and not after.touching.any()


def test_the_impulse_at_one_point_is_that_of_newton_and_euler():
    # depth 0.08 at r = (0.1, 0, 0): r x n = (0, -0.1, 0), response 1 + 100 * 0.1^2 = 2, impulse 0.04
    before, after = resolve([0.02, 0.5, 0.5])

    assert torch.allclose(after.step.displacements - before.displacements, 0.04 * UP)
    expected = torch.tensor([0.0, -100 * 0.1 * 0.04, 0.0], dtype=torch.float64)
    assert torch.allclose(after.step.spins[0, 0], expected)
    assert after.touching.all()


def test_more_rounds_leave_no_point_inside():
    _, after = resolve([0.02, 0.03, 0.02], num_iterations=30)

    turned = after.step.turned(POINTS, torch.zeros(1, 3, dtype=torch.int64))
    ahead = torch.tensor([0.02, 0.03, 0.02]) + after.step.displacements[..., 2] + (turned - POINTS)[..., 2]
    assert ahead.min() > -0.005


def test_a_point_deep_inside_is_left_alone():
    before, after = resolve([-0.2, 0.5, 0.5])

    assert torch.equal(after.step.displacements, before.displacements)


def test_friction_takes_at_most_its_share_of_the_impulse_from_sliding():
    # No inertia to turn: depth 0.08 is the impulse, friction 0.5 allows 0.04 of it against 0.06 of sliding.
    before, after = resolve([0.02, 0.5, 0.5], inverse_inertia=0.0, friction=0.5, velocity=(0.0, 0.06, -0.1))

    change = (after.step.displacements - before.displacements)[0, 0]
    assert torch.allclose(change, torch.tensor([0.0, -0.04, 0.08], dtype=torch.float64))


def test_enough_friction_stops_the_sliding_and_never_reverses_it():
    _, after = resolve([0.02, 0.5, 0.5], inverse_inertia=0.0, friction=5.0, velocity=(0.0, 0.06, -0.1))

    expected = torch.tensor([0.0, 0.0, -0.02], dtype=torch.float64)
    assert torch.allclose(after.step.displacements[0, 0], expected, atol=1e-9)


@pytest.mark.parametrize("restitution", [0.0, 0.4, 1.0])
def test_what_goes_on_leaves_with_its_share_of_the_approach(restitution):
    _, after = resolve([0.02, 0.5, 0.5], inverse_inertia=0.0, restitution=restitution)

    assert after.step.displacements[0, 0, 2].item() == pytest.approx(-0.02)  # as far as the floor in this step
    assert after.onward.displacements[0, 0, 2].item() == pytest.approx(0.1 * restitution, abs=1e-9)


def ball_with_poles(count=120, radius=0.15):
    """One point lies exactly below the centre, so that a floor pushes through the centre."""
    points, normals = even_ball(count, radius)
    poles = torch.cat([EYE, -EYE])
    return torch.cat([points, radius * poles]), torch.cat([normals, poles])


@pytest.mark.parametrize("restitution", [0.0, 0.3, 0.7, 1.0])
def test_a_ball_dropped_on_a_floor_leaves_with_its_share_of_the_approach(restitution):
    world = World([ball_with_poles()], [(0, 0, 0.21)], [(0.01, 0, -0.02)], restitution=restitution)
    for _ in range(5):
        world.step()

    expected = torch.tensor([0.01, 0.0, 0.02 * restitution], dtype=torch.float64)
    assert torch.allclose(world.velocity(), expected, atol=1e-8)  # rest_speed of 1e-9
    assert (world.motion.spins == 0).all()


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_a_cube_dropped_flat_on_a_floor_bounces_without_turning(restitution):
    world = World([even_cube(6)], [(0, 0, 0.21)], [(0, 0, -0.02)], restitution=restitution)
    for _ in range(5):
        world.step()

    # Four corners, one after the other: what is left of the turn is below a thousandth of a radian a step.
    assert world.velocity()[2].item() == pytest.approx(0.02 * restitution, abs=2e-4)
    assert world.motion.spins.abs().max() < 1e-3


def test_a_bouncing_ball_rises_to_the_square_of_its_restitution():
    gravity, restitution, height = 1e-3, 0.6, 0.3
    world = World([ball_with_poles()], [(0, 0, 0.15 + height)], [(0, 0, 0)], gravity=gravity, restitution=restitution)
    heights = []
    for _ in range(42):
        world.step()
        heights.append(world.center()[2].item() - 0.15)
    first = min(range(27), key=lambda step: heights[step])

    # Steps of up to 24 mm: the impact falls between two of them.
    assert max(heights[first:]) == pytest.approx(restitution**2 * height, abs=0.02)


@pytest.mark.parametrize("friction", [0.2, 0.5])
def test_a_sliding_block_stops_where_coulomb_says(friction):
    gravity, speed = 0.01, 0.05
    world = World([even_cube(4)], [(0, 0, 0.15)], [(speed, 0, 0)], gravity=gravity, friction=friction)
    for _ in range(round(speed / (friction * gravity)) + 5):
        world.step()

    # v^2 / (2 mu g) for steps without end, and half a step less for those that there are; corners take turns to touch
    distance = speed**2 / (2 * friction * gravity)
    assert distance - 0.6 * speed - 0.01 < world.center()[0].item() < distance + 0.01
    assert world.velocity().norm() < 2e-3 and world.center()[1].abs() < 0.01
    assert world.center()[2].item() == pytest.approx(0.15, abs=1e-4)


def test_without_friction_a_block_slides_on_for_ever():
    world = World([even_cube(4)], [(0, 0, 0.15)], [(0.05, 0, 0)], gravity=0.01)
    for _ in range(20):
        world.step()

    assert world.center()[0].item() == pytest.approx(1.0, abs=1e-3)


def test_a_spinning_ball_with_friction_is_driven_forward():
    # The point below moves backwards with r omega; friction pushes it, and the ball with it, the other way.
    world = World([ball_with_poles()], [(0, 0, 0.15)], [(0, 0, 0)], [(0, 0.1, 0)], gravity=0.01, friction=0.3)
    for _ in range(3):
        world.step()

    assert world.velocity()[0] > 1e-3 and world.motion.spins[0, 0, 1] < 0.1


def test_a_tilted_cube_falls_onto_a_face():
    points, normals = even_cube(6)
    turn = rotation_about([0, 1, 0], 0.5)
    world = World([(points @ turn.T, normals @ turn.T)], [(0, 0, 0.25)], [(0, 0, 0)], gravity=0.01, friction=0.5)
    lowest = []
    for _ in range(25):
        world.step()
        lowest.append(world.positions[..., 2].min().item())

    assert min(lowest) > -0.01
    heights = world.positions[0, :, 2]
    assert world.center()[2].item() == pytest.approx(0.15, abs=0.01) and heights.max() < 0.32


@pytest.mark.parametrize("softness", [0.1, 1.0])
def test_a_soft_ball_is_flattened_and_comes_round_again(softness):
    world = World([ball_with_poles()], [(0, 0, 0.16)], [(0, 0, -0.04)], softness=softness, restitution=0.2, damping=0.4)
    flattest = 0.0
    for _ in range(25):
        world.step()
        stretch = world.motion.stretches[0, 0]
        flattest = min(flattest, stretch[2, 2].item() - 1)
        assert (stretch - EYE).norm() <= 0.6 + 1e-9
    assert flattest < -0.01
    assert (world.motion.stretches[0, 0] - EYE).norm() < 0.01
    assert world.velocity()[2] > 0


def test_single_precision_keeps_still_what_lies_still():
    world = World([even_cube(5)], [(0, 0, 0.15)], [(0, 0, 0)], gravity=0.01, friction=0.5, dtype=torch.float32)
    for _ in range(25):
        world.step()

    assert (world.center() - torch.tensor([0.0, 0.0, 0.15])).norm() < 2e-3


@pytest.mark.parametrize("name", ["friction", "restitution", "positions", "velocity"])
def test_gradients_of_an_impact_are_those_of_finite_differences(name):
    def world():
        return World(
            [even_ball(10)], [(0, 0, 0.14)], [(0.02, 0.01, -0.05)], friction=0.2, restitution=0.5, num_iterations=2
        )

    def outcome(value):
        made = world()
        if name in ("friction", "restitution"):
            made.materials = replace(made.materials, **{name: value})
        elif name == "positions":
            made.positions = value
        else:
            made.motion = replace(made.motion, displacements=value)
        resolved = made.resolve()
        return resolved.step.displacements, resolved.onward.displacements, resolved.onward.spins

    start = world()
    materials, motion = start.materials, start.motion
    value = {
        "friction": materials.friction,
        "restitution": materials.restitution,
        "positions": start.positions,
        "velocity": motion.displacements,
    }[name]
    assert torch.autograd.gradcheck(outcome, (value.clone().requires_grad_(),), eps=1e-7, atol=1e-5)
