"""Bodies that strike and carry each other: momentum, energy and rest."""

import pytest
import torch

from tests.dynamics.contact_world import World
from tests.dynamics.solids import even_ball, even_cube, random_rotation
from vpd_lightning.dynamics.inertial.contact_search import ContactPoints, nearest_body_contacts


def momentum(world, motion):
    return (world.mass * motion.displacements).sum(dim=1)[0]


def angular_momentum(world, motion):
    """About the origin, with the inertia of this instant."""
    inertia = torch.linalg.inv(world.inertia().inverse_turning[0])
    spin = (inertia @ motion.spins[0, ..., None])[..., 0]
    return (world.mass[0] * (torch.linalg.cross(motion.centers[0], motion.displacements[0]) + spin)).sum(dim=0)


def energy(world, motion):
    inertia = torch.linalg.inv(world.inertia().inverse_turning[0])
    turning = (motion.spins[0] * (inertia @ motion.spins[0, ..., None])[..., 0]).sum(dim=-1)
    return (world.mass[0, :, 0] * (motion.displacements[0].square().sum(dim=-1) + turning)).sum().item() / 2


def turned(shape, seed):
    return tuple(values @ random_rotation(seed).T for values in shape)


def oblique(seed, softness=0.0, **changes):
    shapes = [turned(even_cube(5), seed), turned(even_ball(100), seed + 50)]
    return World(
        shapes, [(0, 0, 0), (0.33, 0.03, 0.02)], [(0.05, 0.02, 0), (-0.03, 0, 0.01)], [(0.1, 0, 0.05), (0, 0.1, 0)],
        masses=[1.0, 3.0], has_floor=False, softness=softness, **{"friction": 0.4, "restitution": 0.5, **changes},
    )  # fmt: skip


@pytest.mark.parametrize("softness", [0.0, 0.6])
@pytest.mark.parametrize("seed", range(4))
def test_bodies_that_strike_keep_their_momentum(seed, softness):
    world = oblique(seed, softness)
    resolved = world.resolve()

    assert resolved.touching.all()
    for motion in (resolved.step, resolved.onward):
        assert torch.allclose(momentum(world, motion), momentum(world, world.motion), atol=1e-15)
    assert not torch.allclose(resolved.onward.displacements, world.motion.displacements, atol=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_angular_momentum_is_kept_but_for_how_far_the_step_itself_goes(seed):
    shapes = [turned(even_ball(150), seed), turned(even_ball(150), seed + 50)]
    world = World(shapes, [(0, 0, 0), (0.298, 0, 0)], [(0, 1e-3, 0), (0, 0, 1e-3)], masses=[1.0, 3.0], friction=0.4,
                  restitution=0.5, has_floor=False)  # fmt: skip
    resolved = world.resolve()

    impulse = (resolved.onward.displacements - world.motion.displacements)[0, 0].norm()
    error = angular_momentum(world, resolved.onward) - angular_momentum(world, world.motion)

    # The push acts at places of the end of the step, 1 to 2 mm on. Were the two bodies pushed at their own nearest
    # points, which lie a centimetre or two apart, it would be ten times as much.
    assert impulse > 1e-4
    assert error.norm() / impulse < 3e-3


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("restitution", [0.0, 1.0])
def test_a_strike_takes_energy_or_nearly_keeps_it(seed, restitution):
    world = oblique(seed, restitution=restitution)
    resolved = world.resolve()

    before, after = energy(world, world.motion), energy(world, resolved.onward)
    # With full restitution each of several contacts gives back its own approach: up to 17 % too much in these.
    assert after < 1.25 * before
    if restitution == 0:
        assert after < 0.9 * before


MASSES = [(1.0, 1.0), (1.0, 3.0)]


@pytest.mark.parametrize("masses", MASSES)
@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("make", [lambda: even_ball(120), lambda: even_cube(6)])
def test_head_on_bodies_part_with_their_share_of_the_approach(make, restitution, masses):
    world = World([make(), make()], [(0, 0, 0), (0.33, 0, 0)], [(0.05, 0, 0), (0, 0, 0)], masses=list(masses),
                  restitution=restitution, has_floor=False)  # fmt: skip
    for _ in range(3):
        world.step()

    first, second = masses
    common, approach = first * 0.05 / (first + second), 0.05
    expected = (common - second * restitution * approach / (first + second),
                common + first * restitution * approach / (first + second))  # fmt: skip
    # Equal masses and restitution 1: they exchange velocities; 0: they go on together. 2 %: points are not the surface,
    # and a cube's corners are pushed one after the other.
    assert world.velocity(0)[0].item() == pytest.approx(expected[0], abs=1e-3)
    assert world.velocity(1)[0].item() == pytest.approx(expected[1], abs=1e-3)
    assert world.velocity(0)[1:].abs().max() < 1e-3


def test_slow_bodies_do_not_bounce():
    world = World([even_cube(6)] * 2, [(0, 0, 0), (0.33, 0, 0)], [(0.02, 0, 0), (0, 0, 0)], restitution=1.0,
                  rest_speed=0.03, has_floor=False)  # fmt: skip
    for _ in range(3):
        world.step()

    assert torch.allclose(world.velocity(0), world.velocity(1), atol=1e-3)


def test_bodies_apart_do_not_know_of_each_other():
    world = World([even_cube(5)] * 2, [(0, 0, 0), (0.6, 0, 0)], [(0.05, 0, 0), (0, 0.01, 0)], has_floor=False)
    resolved = world.resolve()

    assert torch.equal(resolved.onward.displacements, world.motion.displacements) and not resolved.touching.any()


def test_a_stack_of_two_blocks_stays():
    world = World([even_cube(4)] * 2, [(0, 0, 0.15), (0.02, 0.01, 0.45)], [(0, 0, 0)] * 2, gravity=0.01, friction=0.5)
    for _ in range(12):
        world.step()

    # The lower block gives way by 3 mm; 4 rounds a step leave a little of the upper one's weight in it.
    assert world.center(0)[2].item() == pytest.approx(0.15, abs=0.005)
    assert world.center(1)[2].item() == pytest.approx(0.45, abs=0.008)
    assert world.center(0)[:2].norm() < 0.01 and (world.center(1)[:2] - torch.tensor([0.02, 0.01])).norm() < 0.03


def test_a_block_pushed_against_another_pushes_it_along():
    world = World([even_cube(5)] * 2, [(0, 0, 0.15), (0.31, 0, 0.15)], [(0.04, 0, 0), (0, 0, 0)], friction=0.05,
                  gravity=0.001)  # fmt: skip
    for _ in range(8):
        world.step()

    gap = (world.center(1) - world.center(0))[0].item()
    assert 0.29 < gap < 0.33 and world.velocity(1)[0] > 0.015


def test_empty_places_change_nothing_and_gradients_stay_finite():
    outcomes = []
    for num_empty in (0, 3):
        world = World([even_cube(4), even_ball(60)], [(0, 0, 0.14), (0.29, 0, 0.15)], [(0.05, 0, -0.02), (0, 0, 0)],
                      friction=0.3, restitution=0.4, num_empty=num_empty)  # fmt: skip
        positions = world.positions = world.positions.requires_grad_()
        resolved = world.resolve()
        (resolved.onward.displacements.sum() + resolved.step.spins.square().sum()).backward()
        assert torch.isfinite(positions.grad).all() and positions.grad.any()
        assert (resolved.onward.displacements[0, 2:] == 0).all() and not resolved.touching[0, 2:].any()
        outcomes.append((resolved.onward.displacements[0, :2], resolved.onward.spins[0, :2]))

    for one, other in zip(*outcomes, strict=True):
        assert torch.allclose(one, other, atol=1e-15)


@pytest.mark.parametrize("count", [1, 2])
def test_bodies_of_one_or_two_coincident_points_are_finite(count):
    point = torch.zeros(count, 3, dtype=torch.float64), torch.tensor([[0.0, 0.0, -1.0]] * count, dtype=torch.float64)
    above = point[0], -point[1]
    world = World([above, point], [(0, 0, -0.01), (0, 0, -0.01)], [(0, 0, 0.02), (0, 0, -0.02)], friction=0.5,
                  restitution=0.5, softness=0.5)  # fmt: skip
    positions = world.positions = world.positions.requires_grad_()
    resolved = world.resolve()
    (
        resolved.onward.displacements.square().sum() + resolved.onward.spins.sum() + resolved.step.strains.sum()
    ).backward()

    assert torch.isfinite(positions.grad).all()
    for motion in (resolved.step, resolved.onward):
        assert all(torch.isfinite(value).all() for value in vars(motion).values())


def contact_points():
    generator = torch.Generator().manual_seed(4)
    positions = 0.3 * torch.rand(1, 40, 3, generator=generator, dtype=torch.float64)
    normals = torch.nn.functional.normalize(torch.randn(1, 40, 3, generator=generator, dtype=torch.float64), dim=-1)
    normals[:, ::5] = 0.0
    owner = torch.arange(40) % 4  # the fourth of them owns nothing
    members = (owner == torch.arange(3)[:, None])[None].double()
    return ContactPoints(positions, normals, members), owner


def test_each_point_is_held_against_the_nearest_of_another_body():
    points, owner = contact_points()
    reach, depth = 0.08, 0.03
    found = nearest_body_contacts(points, torch.tensor([reach]).double(), torch.full((1, 40), depth).double())

    for probe in range(40):
        offsets = points.positions[0, probe] - points.positions[0]
        usable = (owner != owner[probe]) & (owner < 3) & (points.normals[0].norm(dim=-1) > 0.5)
        nearest = offsets.norm(dim=-1).masked_fill(~usable, torch.inf).argmin()
        height = offsets[nearest] @ points.normals[0, nearest]
        beside = (offsets[nearest] - height * points.normals[0, nearest]).norm()
        expected = owner[probe] < 3 and beside < reach and height > -depth
        assert found.known[0, probe].item() == bool(expected), probe
        if expected:
            assert found.other[0, probe] == nearest
    assert 0 < found.known.sum() < 30
