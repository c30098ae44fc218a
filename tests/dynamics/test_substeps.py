"""Contact in parts of a step: sliding, standing, falling and pushing of a cube with known answers. Metres and steps."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.dynamics.solids import even_cube
from tests.dynamics.test_driven_bodies import HALF, OneBody, moved, plate
from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, body_inertia
from vpd_lightning.dynamics.inertial.contact import Resolved
from vpd_lightning.dynamics.inertial.contact_search import BodyContacts, ContactPoints, Contacts
from vpd_lightning.dynamics.inertial.materials import Materials
from vpd_lightning.dynamics.inertial.substeps import SubstepSolver

GRAVITY = 0.0157  # of 40 ms a step


def cube(height: float, velocity: tuple[float, float, float]) -> tuple[Tensor, BodyMotion]:
    positions = even_cube(6, HALF)[0] + torch.tensor([0, 0, HALF + height]).double()
    center = torch.tensor([[[0.0, 0.0, HALF + height]]]).double()
    eye = torch.eye(3).double()[None, None]
    return positions[None], BodyMotion(
        center, torch.tensor([[velocity]]).double(), torch.zeros_like(center), eye, 0 * eye
    )


def stepped(
    positions: Tensor,
    before: BodyMotion,
    friction: float = 0.0,
    restitution: float = 0.0,
    num_substeps: int = 8,
    gravity: float = GRAVITY,
) -> Resolved:
    """One step above a floor at z = 0."""
    one = torch.ones(1, 1, 1).double()
    members = torch.ones(1, 1, positions.shape[1]).double()
    up = torch.tensor([0, 0, 1.0]).double().expand_as(positions)
    floor = Contacts(positions[..., 2], up, torch.zeros_like(positions[..., 2]))
    free = replace(before, displacements=before.displacements - torch.tensor([0, 0, gravity]).double())
    solver = SubstepSolver(
        points=ContactPoints(positions, torch.zeros_like(positions), members),
        centers=before.centers,
        inertia=body_inertia(positions, before.centers, members / members.sum(), 0 * one, torch.ones(()).double()),
        materials=Materials(friction * one, restitution * one, one, 0 * one, 0.25 * one, 0.1 * one),
        masses=one,
        rest_speed=0.3 * GRAVITY,
    )
    return solver.resolve_in_parts(before, free, floor, None, num_substeps=num_substeps, max_depth=0.02)


def test_in_free_flight_nothing_is_different() -> None:
    positions, before = cube(1.0, (0.01, 0.02, 0.03))
    found = stepped(positions, before)
    expected = torch.tensor([0.01, 0.02, 0.03 - GRAVITY]).double()
    assert torch.allclose(found.onward.displacements[0, 0], expected) and not found.touching.any()
    # Semi-implicit in each part: the mean velocity of the step, and half a part more.
    assert found.step.displacements[0, 0, 2].item() == pytest.approx(0.03 - GRAVITY * (0.5 + 0.5 / 8))


def test_what_stands_stays() -> None:
    positions, before = cube(0.0, (0.0, 0.0, 0.0))
    for _ in range(5):
        found = stepped(positions, before, friction=0.5)
        before = replace(found.onward, centers=before.centers)
    assert found.touching.all() and found.step.displacements.norm() < 2e-3
    assert found.step.spins.norm() < 0.02, "radians"


@pytest.mark.parametrize("friction", [0.1, 0.3, 0.6])
def test_what_slides_slows_by_friction_times_gravity_and_does_not_tip(friction: float) -> None:
    positions, before = cube(0.0, (0.03, 0.0, 0.0))
    found = stepped(positions, before, friction=friction, num_substeps=16)
    lost = 0.03 - found.onward.displacements[0, 0, 0].item()
    assert lost == pytest.approx(min(friction * GRAVITY, 0.03), rel=0.25)
    assert found.step.spins.norm() < 0.1 and abs(found.step.displacements[0, 0, 2].item()) < 0.003


def test_at_once_the_same_cube_tips() -> None:
    positions, before = cube(0.0, (0.03, 0.0, 0.0))
    parts, at_once = (stepped(positions, before, 0.6, num_substeps=count).step.spins.norm() for count in (16, 1))
    assert at_once > 2 * parts


def test_what_falls_bounces_by_its_restitution() -> None:
    positions, before = cube(0.005, (0.0, 0.0, -0.06))
    for restitution in (0.0, 0.5):
        found = stepped(positions, before, restitution=restitution, gravity=0.0)
        wanted = restitution * (0.06 - 0.3 * GRAVITY)
        assert found.onward.displacements[0, 0, 2].item() == pytest.approx(wanted, abs=2e-3)
        assert found.step.displacements[0, 0, 2].item() > -0.0051 - 0.06 / 8


def test_what_penetrates_comes_out_without_speed() -> None:
    positions, before = cube(-0.004, (0.0, 0.0, 0.0))
    found = stepped(positions, before, gravity=0.0)
    assert found.step.displacements[0, 0, 2].item() == pytest.approx(0.004, rel=0.1)
    assert found.onward.displacements.norm() < 1e-9


@pytest.mark.parametrize("gap", [0.001, 0.008])
def test_a_plate_takes_a_cube_along_at_its_own_speed(gap: float) -> None:
    body = OneBody(even_cube(5, HALF), (HALF + gap, 0, 0))
    found = body.step(moved(plate(0.0), (0.02, 0, 0)), num_substeps=16)
    assert found is not None
    assert found.onward.displacements[0, 0, 0].item() == pytest.approx(0.02, rel=0.02)
    assert found.step.displacements[0, 0, 0].item() == pytest.approx(0.02 - gap, abs=2e-3)
    assert torch.allclose(found.step.displacements[0, 1], torch.tensor([0.02, 0, 0]).double(), atol=1e-9)


def test_two_bodies_that_collide_keep_their_momentum() -> None:
    positions = torch.cat([even_cube(5, HALF)[0] + torch.tensor([x, 0, 0]).double() for x in (0.0, 2 * HALF + 0.002)])
    normals = torch.cat([even_cube(5, HALF)[1]] * 2)[None]
    count = len(positions) // 2
    members = torch.zeros(1, 2, 2 * count).double()
    members[0, 0, :count] = members[0, 1, count:] = 1
    centers = torch.tensor([[[0.0, 0, 0], [2 * HALF + 0.002, 0, 0]]]).double()
    eye = torch.eye(3).double().expand(1, 2, 3, 3)
    before = BodyMotion(
        centers, torch.tensor([[[0.02, 0, 0], [-0.01, 0, 0]]]).double(), torch.zeros_like(centers), eye, 0 * eye
    )
    one = torch.ones(1, 2, 1).double()
    masses = torch.tensor([[[1.0], [3.0]]]).double()
    distances = (positions[:, None] - positions).norm(dim=-1)
    distances[:count, :count] = distances[count:, count:] = torch.inf
    far = torch.full((1, 2 * count), 10.0).double()
    solver = SubstepSolver(
        points=ContactPoints(positions[None], normals, members),
        centers=centers,
        inertia=body_inertia(
            positions[None], centers, members / members.sum(-1, keepdim=True), 0 * one, torch.ones(()).double()
        ),
        materials=Materials(0 * one, 0 * one, one, 0 * one, 0.25 * one, 0.1 * one),
        masses=masses,
        rest_speed=1e-9,
    )
    between = BodyContacts(distances.argmin(dim=1)[None], torch.ones(1, 2 * count, dtype=torch.bool))
    nothing = Contacts(far, torch.zeros_like(positions)[None], far)
    found = solver.resolve_in_parts(before, before, nothing, between, num_substeps=8, max_depth=0.1)
    old, new = ((masses * motion.displacements).sum(dim=1) for motion in (before, found.onward))
    assert torch.allclose(old, new, atol=1e-12) and found.touching.all()
    assert (found.onward.displacements[0, 1, 0] - found.onward.displacements[0, 0, 0]).item() > -0.05 * 0.03
