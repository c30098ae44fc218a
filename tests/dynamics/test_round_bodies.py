"""Ellipsoids: found from the half that is seen, and rolling as the smooth bodies that they are. Metres and steps."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.dynamics.solids import even_cube, random_rotation
from vpd_lightning.dynamics.inertial.body_forces import BodyForces
from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, body_inertia
from vpd_lightning.dynamics.inertial.contact_search import ContactPoints, Contacts, nearest_static_contacts
from vpd_lightning.dynamics.inertial.materials import Materials
from vpd_lightning.dynamics.inertial.rigid_motion import rotation_from_spin
from vpd_lightning.dynamics.inertial.round_bodies import fit_ellipsoids, on_feet, rolling, touches, with_feet
from vpd_lightning.dynamics.inertial.substeps import SubstepSolver
from vpd_lightning.dynamics.inertial.surface_edges import SurfaceEdges

FAR = 10.0
GRAVITY = 0.0157
RADIUS = 0.045


def ellipsoid(count: int, axes: tuple[float, float, float], turn: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return points about the middle and normals, from directions drawn evenly."""
    draw = torch.Generator().manual_seed(count)
    directions = torch.randn(count, 3, generator=draw, dtype=torch.float64)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    half = torch.tensor(axes, dtype=torch.float64)
    normals = directions / half
    normals = normals / normals.norm(dim=-1, keepdim=True)
    turn = torch.eye(3).double() if turn is None else turn
    return (directions * half) @ turn.T, normals @ turn.T


def capsule(count: int, radius: float, length: float) -> tuple[Tensor, Tensor]:
    """Points of a segment along x and a ball around it."""
    points, normals = ellipsoid(count, (radius, radius, radius))
    along = torch.rand(count, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 2 - 1
    is_side = torch.arange(count) % 3 > 0
    radial = normals[:, 1:] / normals[:, 1:].norm(dim=-1, keepdim=True)
    side = torch.cat([torch.zeros(count, 1).double(), radial], dim=-1)
    normals = torch.where(is_side[:, None], side, normals)
    middle = torch.where(is_side, length * along, length * points[:, 0].sign())
    return radius * normals + torch.stack([middle, 0 * middle, 0 * middle], dim=-1), normals


def cylinder(count: int, radius: float, half: float) -> tuple[Tensor, Tensor]:
    draw = torch.Generator().manual_seed(4)
    angle, up, out = (torch.rand(count, generator=draw, dtype=torch.float64) for _ in range(3))
    ring = torch.stack([torch.cos(2 * math.pi * angle), torch.sin(2 * math.pi * angle), 0 * angle], dim=-1)
    top = torch.tensor([0, 0, 1.0]).double()
    is_side = (torch.arange(count) % 2 == 0)[:, None]
    side, lid = radius * ring + half * (2 * up - 1)[:, None] * top, radius * out.sqrt()[:, None] * ring + half * top
    return torch.where(is_side, side, lid), torch.where(is_side, ring, top)


def fitted(points: Tensor, normals: Tensor, guess: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Fit one body, with a wrong guess of the centre unless one is given."""
    members = torch.ones(1, 1, len(points)).double()
    start = points.mean(dim=0) if guess is None else guess
    centers, shapes = fit_ellipsoids(points[None], normals[None], members, start[None, None])
    return centers[0, 0], shapes[0, 0]


def seen_half(points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """What cameras above see: faces that look up or sideways."""
    kept = normals[:, 2] > -0.2
    return points[kept], normals[kept]


@pytest.mark.parametrize("axes", [(0.045, 0.045, 0.045), (0.03, 0.04, 0.06), (0.06, 0.035, 0.035)])
@pytest.mark.parametrize("seed", [0, 1])
def test_an_ellipsoid_is_found_from_its_upper_half(axes: tuple[float, float, float], seed: int) -> None:
    turn, place = random_rotation(seed).double(), torch.tensor([0.3, -0.2, 0.1]).double()
    points, normals = seen_half(*ellipsoid(300, axes, turn))
    center, shape = fitted(points + place, normals)
    true = turn @ torch.diag(torch.tensor(axes).double().square()) @ turn.T
    assert (center - place).norm() < 0.002
    assert torch.allclose(shape, true, atol=0.05 * max(axes) ** 2)


def test_noise_and_strays_move_it_little() -> None:
    points, normals = seen_half(*ellipsoid(400, (0.03, 0.04, 0.06)))
    draw = torch.Generator().manual_seed(0)
    points = points + 0.001 * torch.randn(points.shape, generator=draw, dtype=torch.float64)
    normals = normals + 0.1 * torch.randn(points.shape, generator=draw, dtype=torch.float64)
    normals = normals / normals.norm(dim=-1, keepdim=True)
    points[::25] += torch.tensor([0.02, 0.0, 0.02]).double()
    center, shape = fitted(points, normals)
    assert center.norm() < 0.006
    assert torch.linalg.eigvalsh(shape).sqrt().tolist() == pytest.approx([0.03, 0.04, 0.06], rel=0.2)


def test_a_capsule_is_taken_for_one_about_the_given_centre() -> None:
    points, normals = seen_half(*capsule(300, 0.03, 0.02))
    center, shape = fitted(points, normals, torch.zeros(3).double())
    assert center.norm() < 1e-9
    assert torch.linalg.eigvalsh(shape).sqrt().tolist() == pytest.approx([0.03, 0.03, 0.05], rel=0.1)


@pytest.mark.parametrize("solid", [even_cube(6, 0.04), cylinder(300, 0.04, 0.04), ellipsoid(12, (0.04, 0.04, 0.04))])
def test_cubes_cylinders_and_few_points_are_none(solid: tuple[Tensor, Tensor]) -> None:
    points, normals = seen_half(solid[0], solid[1])
    guess = torch.tensor([0.001, 0.002, 0.0]).double()
    center, shape = fitted(points, normals, guess)
    assert torch.equal(center, guess) and not shape.any()


def ground(half: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """A floor at z = 0, a point every 5 cm."""
    axis = torch.arange(-20, 21, dtype=torch.float64) / 20 * half
    x, y = (values.flatten() for values in torch.meshgrid(axis, axis, indexing="ij"))
    positions = torch.stack([x, y, torch.zeros_like(x)], dim=-1)[None]
    return positions, torch.tensor([0, 0, 1.0]).double().expand_as(positions), torch.ones_like(positions[..., 0]) > 0


def feet_of(
    shapes: Tensor, centers: Tensor, statics: tuple[Tensor, Tensor, Tensor], edges: SurfaceEdges | None = None
) -> Contacts:
    """Return the contacts of feet alone, for bodies without other points."""
    nothing = ContactPoints(centers[:, :0], centers[:, :0], centers.new_zeros(1, centers.shape[1], 0))
    points = with_feet(
        nothing, shapes, resting_motion(centers, (0, 0, 0)), statics, edges, torch.zeros_like(centers[..., 0]), FAR
    )
    assert points.feet is not None
    return points.feet.contacts


def balls(*centers: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
    places = torch.tensor([centers], dtype=torch.float64)
    return RADIUS**2 * torch.eye(3).double().expand(1, len(centers), 3, 3), places


def test_a_foot_is_as_far_from_a_plane_as_the_body() -> None:
    shapes, centers = balls((0.1, 0.12, 0.1))
    found = feet_of(shapes, centers, ground())
    assert found.distances[0].tolist() == pytest.approx([0.1 - RADIUS, FAR])  # there is no second surface
    turn = random_rotation(3).double()
    tilted = turn @ torch.diag(torch.tensor([0.03, 0.04, 0.06]).double().square()) @ turn.T
    dense = ellipsoid(200_000, (0.03, 0.04, 0.06), turn)[0][:, 2]
    found = feet_of(tilted[None, None], centers, ground())
    assert found.distances[0, 0].item() == pytest.approx(0.1 + dense.min().item(), abs=1e-5)


def test_in_a_corner_a_body_has_a_foot_on_either_surface() -> None:
    positions, normals, _ = ground()
    wall = positions[..., [2, 0, 1]][:, (positions[0, :, 1] > 0)] + torch.tensor([-0.2, 0.0, 0.0]).double()
    both = torch.cat([positions, wall], dim=1)
    facing = torch.cat([normals, torch.tensor([1.0, 0, 0]).double().expand_as(wall)], dim=1)
    shapes, centers = balls((-0.14, 0.02, 0.05))
    found = feet_of(shapes, centers, (both, facing, torch.ones_like(both[..., 0]) > 0))
    assert sorted(found.distances[0].tolist()) == pytest.approx([0.05 - RADIUS, 0.06 - RADIUS])


@pytest.mark.parametrize("beyond", [-0.01, 0.01, 0.03, 0.06])
def test_beyond_an_edge_a_foot_faces_the_edge(beyond: float) -> None:
    positions, normals, mask = ground(0.5)
    near = positions[..., 0] > 0.4
    outward = torch.tensor([1.0, 0, 0]).double() * near[..., None]
    ends = torch.where(near, 0.5 - positions[..., 0], torch.inf)
    edges = SurfaceEdges(torch.full_like(ends, 0.1), outward, ends)
    shapes, centers = balls((0.5 + beyond, 0.01, 0.04))
    found = feet_of(shapes, centers, (positions, normals, mask), edges)
    assert found.distances[0, 0].item() == pytest.approx(math.hypot(max(beyond, 0), 0.04) - RADIUS)
    towards = torch.tensor([max(beyond, 0), 0.0, 0.04]).double()
    assert torch.allclose(found.normals[0, 0], towards / towards.norm())


def test_without_anything_that_stands_still_there_are_no_feet() -> None:
    shapes, centers = balls((0.0, 0.0, 0.1))
    nothing = ContactPoints(centers[:, :0], centers[:, :0], centers.new_zeros(1, 1, 0))
    empty = tuple(part[:, :0] for part in ground())
    at_rest = resting_motion(centers, (0, 0, 0))
    assert with_feet(nothing, shapes, at_rest, empty, None, torch.zeros(1, 1).double(), FAR).feet is None
    assert with_feet(nothing, 0 * shapes, at_rest, ground(), None, torch.zeros(1, 1).double(), FAR).feet is None


def test_what_a_body_is_deep_in_is_not_under_it() -> None:
    shapes, centers = balls((0.0, 0.0, 0.3 * RADIUS))
    assert feet_of(shapes, centers, ground()).distances.tolist() == [[FAR, FAR]]


def resting_motion(centers: Tensor, velocity: tuple[float, float, float]) -> BodyMotion:
    eye = torch.eye(3).double().expand(*centers.shape, 3)
    moves = torch.zeros_like(centers) + torch.tensor(velocity).double()
    return BodyMotion(centers, moves, torch.zeros_like(centers), eye, torch.zeros_like(eye))


def test_what_is_on_a_surface_rolls_unless_it_is_held() -> None:
    shapes, centers = balls((0, 0, RADIUS), (0.2, 0, RADIUS), (0.4, 0, 0.3))
    nothing = ContactPoints(centers[:, :0], centers[:, :0], centers.new_zeros(1, 3, 0))
    feet = with_feet(
        nothing, shapes, resting_motion(centers, (0, 0, 0)), ground(), None, torch.zeros(1, 3).double(), FAR
    ).feet
    held = torch.tensor([[False, True, False]])
    spins = rolling(resting_motion(centers, (0.02, 0.01, 0)), feet, held).spins[0]
    assert spins[0].tolist() == pytest.approx([-0.01 / RADIUS, 0.02 / RADIUS, 0])
    assert not spins[1:].any(), "one is held, one flies"


def test_what_touches_a_round_body() -> None:
    shapes, centers = balls((0, 0, RADIUS), (0.3, 0, RADIUS))
    shapes = shapes * torch.tensor([1.0, 0.0]).double()[:, None, None]
    places = torch.tensor([[[RADIUS, 0, RADIUS], [0.3, 0, RADIUS]]]).double()
    assert touches(shapes, centers, places, torch.ones(1, 2) > 0).tolist() == [[True, False]]
    assert touches(shapes, centers, places, torch.zeros(1, 2) > 0).tolist() == [[False, False]]
    assert touches(shapes, centers, 1.2 * places, torch.ones(1, 2) > 0).tolist() == [[False, False]]


class Roller:
    """One body of some particles on a floor, moved by the solver in parts."""

    def __init__(self, axes: tuple[float, float, float], speed: float, is_round: bool, turn: Tensor | None = None):
        points, normals = ellipsoid(85, axes, turn)
        half = torch.diag(torch.tensor(axes).double().square())
        turn = torch.eye(3).double() if turn is None else turn
        self.shape = (turn @ half @ turn.T)[None, None] * is_round
        height = (turn @ half @ turn.T)[2, 2].sqrt() if is_round else -points[:, 2].min()
        self.positions = (points + torch.tensor([0, 0, float(height)]).double())[None]
        self.normals = normals[None]
        centers = torch.tensor([[[0.0, 0.0, float(height)]]]).double()
        self.motion = resting_motion(centers, (speed, 0, 0))
        self.motion = replace(self.motion, spins=torch.tensor([[[0.0, speed / float(height), 0.0]]]).double())

    def step(self, friction: float = 0.5) -> None:
        one = torch.ones(1, 1, 1).double()
        members = torch.ones(1, 1, self.positions.shape[1]).double()
        points = ContactPoints(self.positions, self.normals, members)
        motion = self.motion
        points = with_feet(points, self.shape, motion, ground(8.0), None, torch.zeros(1, 1).double(), FAR)
        contacts = on_feet(nearest_static_contacts(points.positions, *ground(8.0), FAR), points, FAR)
        self.inertia = body_inertia(self.positions, motion.centers, members / members.sum(), 0 * one, one[0, 0, 0])
        solver = SubstepSolver(
            points=points,
            centers=motion.centers,
            inertia=self.inertia,
            materials=Materials(friction * one, 0 * one, one, 0 * one, 0.25 * one, 0.1 * one),
            masses=one,
            rest_speed=0.3 * GRAVITY,
        )
        free = replace(motion, displacements=motion.displacements - torch.tensor([0, 0, GRAVITY]).double())
        found = solver.resolve_in_parts(motion, free, contacts, None, num_substeps=4, max_depth=0.02)
        turn = rotation_from_spin(found.step.spins)[0, 0]
        there = motion.centers + found.step.displacements
        self.positions = (self.positions - motion.centers) @ turn.T + there
        self.normals, self.shape = self.normals @ turn.T, turn @ self.shape @ turn.T
        self.motion = replace(found.onward, centers=there)

    def energy(self) -> float:
        """Kinetic and potential, for a mass of 1."""
        motion = self.motion
        turning = torch.linalg.solve(self.inertia.inverse_turning[0, 0], motion.spins[0, 0])
        kinetic = motion.displacements.square().sum() + (turning * motion.spins[0, 0]).sum()
        return float(kinetic) / 2 + GRAVITY * float(motion.centers[0, 0, 2])


def test_a_ball_rolls_on_and_one_of_particles_alone_stops() -> None:
    speeds = {}
    for is_round in (True, False):
        body = Roller((RADIUS, RADIUS, RADIUS), 0.013, is_round)
        for _ in range(40):
            body.step()
        speeds[is_round] = float(body.motion.displacements[0, 0, 0])
    assert speeds[True] == pytest.approx(0.013, rel=0.02)
    assert speeds[False] < 0.7 * 0.013


def test_what_slides_comes_to_roll_at_five_sevenths_of_its_speed() -> None:
    body = Roller((RADIUS, RADIUS, RADIUS), 0.02, True)
    body.motion = replace(body.motion, spins=torch.zeros_like(body.motion.spins))
    for _ in range(30):
        body.step()
    # a solid ball has 2/5 of m r^2, particles on its surface have 2/3
    share = float(1 / (1 + body.inertia.inverse_turning[0, 0, 1, 1] ** -1 / RADIUS**2))
    assert float(body.motion.displacements[0, 0, 0]) / 0.02 == pytest.approx(share, rel=0.1)
    assert float(body.motion.spins[0, 0, 1]) * RADIUS == pytest.approx(
        float(body.motion.displacements[0, 0, 0]), rel=0.03
    )


def test_gradients_are_finite_with_a_body_that_is_none_beside_it() -> None:
    shapes, centers = balls((0, 0, RADIUS), (0.3, 0, RADIUS))
    shapes = (shapes * torch.tensor([1.0, 0.0]).double()[:, None, None]).requires_grad_()
    centers.requires_grad_()
    found = feet_of(shapes, centers, ground())
    (found.distances.sum() + found.normals.sum() + found.lateral.sum()).backward()
    assert shapes.grad is not None and centers.grad is not None
    assert shapes.grad.isfinite().all() and centers.grad.isfinite().all() and centers.grad.any()


@pytest.mark.parametrize("is_damped", [True, False])
def test_motion_is_damped_only_where_that_is_wanted(is_damped: bool) -> None:
    forces = BodyForces(
        hidden_dim=8, message_passing_steps=1, num_forces=2, location_scale=0.1, force_scale=0.06, residual_share=0.0,
        acceleration_gain=1.0, contact_range=0.4, force_reach=None, is_damped=is_damped,
    ).double()  # fmt: skip
    points, _ = ellipsoid(60, (RADIUS, RADIUS, RADIUS))
    members, centers = torch.ones(1, 1, 60).double(), torch.zeros(1, 1, 3).double()
    spinning = replace(resting_motion(centers, (0.01, 0, 0)), spins=torch.tensor([[[0.1, 0.2, 0.3]]]).double())
    nothing_near = Contacts(
        torch.full((1, 60), FAR).double(), torch.zeros(1, 60, 3).double(), torch.zeros(1, 60).double()
    )
    inertia = body_inertia(points[None], centers, members / 60, torch.zeros(1, 1, 1).double(), torch.ones(()).double())
    mask = torch.ones(1, 60) > 0
    touching = ContactPoints(points[None], torch.zeros(1, 60, 3).double(), members)
    made = forces(torch.zeros(1, 60, 3).double(), mask, touching, nothing_near, spinning, inertia)
    share = torch.sigmoid(torch.tensor(5.0)).item() if is_damped else 1.0
    assert torch.allclose(made.spins, share * spinning.spins, atol=1e-6)
    assert torch.allclose(made.displacements, share * spinning.displacements, atol=1e-6)
