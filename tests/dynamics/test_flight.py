"""What flies feels the common acceleration alone, and teaches it. Metres and steps."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.dynamics.contact_world import floor_contacts
from tests.dynamics.solids import ball
from vpd_lightning.dynamics.inertial.body_forces import BodyForces
from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, body_inertia
from vpd_lightning.dynamics.inertial.contact_search import ContactPoints
from vpd_lightning.dynamics.inertial.flight import flight

RADIUS, REACH = 0.1, 0.8
GRAVITY = 0.016


def balls(*centers: tuple[float, float, float], count: int = 40) -> tuple[ContactPoints, Tensor]:
    """Points on all balls, and the centres (1 ball 3)."""
    surface = ball(count, 0, RADIUS)[0].double()
    surface = RADIUS * surface / surface.norm(dim=-1, keepdim=True)
    middles = torch.tensor(centers, dtype=torch.float64)
    whose = torch.arange(len(centers)).repeat_interleave(count)
    members = (whose == torch.arange(len(centers))[:, None]).double()
    normals = surface.repeat(len(centers), 1) / RADIUS
    return ContactPoints((middles[whose] + RADIUS * normals)[None], normals[None], members[None]), middles[None]


def in_flight(*centers: tuple[float, float, float], scale: float = 1.0) -> list[float]:
    points, middles = balls(*centers)
    points = replace(points, positions=scale * points.positions)
    found: list[float] = flight(points, points.positions[..., 2], scale * middles, REACH)[0, :, 0].tolist()
    return found


def made_forces(force_reach: float | None) -> BodyForces:
    """Forces and damping that are not zero."""
    torch.manual_seed(0)
    forces = BodyForces(
        hidden_dim=8, message_passing_steps=1, num_forces=2, location_scale=0.1, force_scale=0.06, residual_share=0.5,
        acceleration_gain=1.0, contact_range=0.4, force_reach=force_reach, is_damped=True,
    ).double()  # fmt: skip
    assert forces.damping is not None
    for layer in (forces.force, forces.weight, forces.damping):
        torch.nn.init.normal_(layer.weight)
    torch.nn.init.constant_(forces.acceleration, 0.1)
    return forces


def after(forces: BodyForces, *centers: tuple[float, float, float], speed: float = 0.01) -> BodyMotion:
    points, middles = balls(*centers)
    positions, members = points.positions, points.members
    count = len(centers)
    velocity = torch.full((1, count, 3), speed, dtype=torch.float64)
    strains = torch.zeros(1, count, 3, 3, dtype=torch.float64)
    motion = BodyMotion(middles, velocity, velocity.clone(), strains, strains.clone())
    shares = members / members.sum(dim=-1, keepdim=True)
    inertia = body_inertia(positions, middles, shares, torch.zeros(1, count, 1).double(), torch.ones(()).double())
    mask = torch.ones(positions.shape[:2], dtype=torch.bool)
    moved = torch.full_like(positions, speed)
    return forces(moved, mask, points, floor_contacts(positions), motion, inertia)


def test_a_body_flies_where_it_is_far_from_all_that_it_could_touch():
    assert in_flight((0, 0, 1.0)) == [1.0]
    assert in_flight((0, 0, RADIUS)) == [0.0] and in_flight((0, 0, RADIUS + 0.04)) == [0.0]
    assert 0 < in_flight((0, 0, RADIUS + 0.06))[0] < 1
    # Two that touch, high above the floor; then 3 cm (between) and 5 cm apart.
    assert in_flight((0, 0, 1.0), (0.2, 0, 1.0)) == [0.0, 0.0]
    assert all(0 < share < 1 for share in in_flight((0, 0, 1.0), (0.23, 0, 1.0)))
    assert in_flight((0, 0, 1.0), (0.25, 0, 1.0), (0, 0, RADIUS)) == [1.0, 1.0, 0.0]
    assert in_flight((0, 0, 1.7), (0, 2.4, 1.0), scale=100.0) == [1.0, 1.0]


def test_places_without_a_body_do_not_fly_and_are_near_nobody():
    points, middles = balls((0, 0, 1.0))
    points = replace(points, members=torch.cat([points.members, torch.zeros_like(points.members)], dim=1))
    middles = torch.cat([middles, middles], dim=1)
    assert flight(points, points.positions[..., 2], middles, REACH)[0, :, 0].tolist() == [1.0, 0.0]


def test_what_is_guessed_of_a_hidden_side_counts():
    """A ball of which the upper half is seen; its image reaches the floor."""
    points, middles = balls((0, 0, RADIUS))
    seen = points.positions[0, :, 2] > RADIUS
    places, normals, members = points.positions[:, seen], points.normals[:, seen], points.members[..., seen]
    upper = ContactPoints(places, normals, members)
    assert flight(upper, places[..., 2], middles, REACH).item() > 0.5
    places = torch.cat([places, 2 * middles - places], dim=1)
    whole = ContactPoints(places, torch.cat([normals, -normals], dim=1), torch.cat([members, members], dim=2))
    assert flight(whole, whole.positions[..., 2], middles, REACH).item() == 0.0


def test_learned_forces_and_damping_act_near_something_alone():
    forces = made_forces(REACH)
    motion = after(forces, (0, 0, 1.0), (1, 0, RADIUS))
    ballistic = 0.01 + forces.common_acceleration()
    assert torch.allclose(motion.displacements[0, 0], ballistic, atol=1e-12)
    assert torch.equal(motion.spins[0, 0], torch.full((3,), 0.01, dtype=torch.float64))
    assert (motion.displacements[0, 1] - ballistic).norm() > 1e-3 and (motion.spins[0, 1] - 0.01).norm() > 1e-3
    everywhere = after(made_forces(None), (0, 0, 1.0), (1, 0, RADIUS))
    assert (everywhere.displacements[0, 0] - ballistic).norm() > 1e-3
    assert torch.equal(everywhere.displacements[0, 1], motion.displacements[0, 1])


def test_the_common_acceleration_is_learned_from_what_flies():
    forces = made_forces(REACH)
    slopes = []
    for body in (0, 1):
        forces.acceleration.grad = None
        after(forces, (0, 0, 1.0), (1, 0, RADIUS)).displacements[0, body].sum().backward()
        assert forces.acceleration.grad is not None
        slopes.append(forces.acceleration.grad.clone())
    assert torch.allclose(slopes[1], 0.03 * slopes[0], rtol=1e-9) and bool((slopes[0] > 0).all())


@pytest.mark.parametrize(("force_reach", "is_found"), [(REACH, True), (None, False)])
def test_bodies_that_lie_do_not_speak_against_gravity(force_reach: float | None, is_found: bool):
    """One body falls, three lie on a floor whose support is left to the forces to learn."""
    forces = made_forces(force_reach)
    for layer in (forces.force, forces.weight):
        torch.nn.init.zeros_(layer.weight)
    torch.nn.init.zeros_(forces.acceleration)
    places = (0, 0, 1.0), (1, 0, RADIUS), (2, 0, RADIUS), (3, 0, RADIUS)
    target = torch.zeros(4, 3, dtype=torch.float64)
    target[0, 2] = -GRAVITY
    teacher = torch.optim.Adam(forces.parameters(), lr=5e-3)
    for _ in range(60):
        teacher.zero_grad()
        (after(forces, *places, speed=0.0).displacements[0] - target).abs().sum().backward()
        teacher.step()
    found = forces.common_acceleration()[2].item()
    assert (abs(found + GRAVITY) < 0.1 * GRAVITY) == is_found, found
