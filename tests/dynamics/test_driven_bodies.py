"""What is driven pushes bodies and is not pushed: a plate and a rod against cubes and balls. Metres and steps."""

from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from tests.dynamics.solids import even_ball, even_cube
from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, body_inertia
from vpd_lightning.dynamics.inertial.contact import Resolved
from vpd_lightning.dynamics.inertial.contact_search import ContactPoints, Contacts
from vpd_lightning.dynamics.inertial.driven_bodies import (
    Surface,
    driven_bodies,
    joined_inertia,
    joined_materials,
    joined_motion,
    meet,
)
from vpd_lightning.dynamics.inertial.materials import Materials
from vpd_lightning.dynamics.inertial.rigid_motion import rotation_from_spin
from vpd_lightning.dynamics.inertial.substeps import SubstepSolver
from vpd_lightning.types import Driven

HALF = 0.05


def plate(x: float, side: int = 9, half: float = 0.08) -> tuple[Tensor, Tensor]:
    """Points and normals of a square that faces +x."""
    axis = (torch.arange(side, dtype=torch.float64) + 0.5) / side * 2 - 1
    y, z = (values.flatten() * half for values in torch.meshgrid(axis, axis, indexing="ij"))
    return torch.stack([torch.full_like(y, x), y, z], dim=-1), torch.tensor([1.0, 0, 0]).double().expand(len(y), 3)


def moved(shape: tuple[Tensor, Tensor], step: tuple[float, float, float], turn: float = 0.0) -> Driven:
    """Points that go by ``step`` and turn about z through the origin."""
    points, normals = shape
    turned = rotation_from_spin(torch.tensor([0.0, 0.0, turn]).double())
    following = points @ turned.T + torch.tensor(step).double()
    groups = torch.zeros(1, len(points), dtype=torch.int64)
    return Driven(
        points[None], normals[None], groups, next_positions=following[None], next_normals=(normals @ turned.T)[None]
    )


class OneBody:
    """A cube or ball of unit mass, free but for what is driven."""

    def __init__(self, shape: tuple[Tensor, Tensor], place: tuple[float, float, float]) -> None:
        self.positions = (shape[0] + torch.tensor(place).double())[None]
        self.normals = shape[1][None]
        self.members = torch.ones(1, 1, self.positions.shape[1]).double()
        eye = torch.eye(3).double()[None, None]
        centers = torch.tensor(place).double()[None, None]
        self.motion = BodyMotion(centers, torch.zeros_like(centers), torch.zeros_like(centers), eye, 0 * eye)

    def step(
        self, driven: Driven, friction: float = 0.0, num_iterations: int = 4, num_substeps: int | None = None
    ) -> Resolved | None:
        """Return the step with what is driven, at once or in parts; None where it meets nothing."""
        own = torch.zeros(1, self.positions.shape[1], dtype=torch.int64)
        bodies = driven_bodies(driven, torch.zeros(1, 1, 3).double())
        spacing = torch.tensor([2.5 * HALF / 4]).double()
        usable = torch.ones_like(own, dtype=torch.bool)
        sizes = torch.tensor([[HALF]]).double()
        radii = (self.positions - self.motion.centers).norm(dim=-1).amax(dim=1, keepdim=True)
        surface = Surface(self.positions, self.normals, own, usable, spacing, sizes, radii)
        points = ContactPoints(self.positions, self.normals, self.members)
        far = torch.full_like(self.positions[..., 0], 10.0)
        nothing = Contacts(far, torch.zeros_like(self.positions), far)
        met = meet(bodies, surface, self.motion, points, nothing, None)
        if met is None:
            return None
        one = torch.ones(1, 1, 1).double()
        materials = Materials(friction * one, 0 * one, one, 0 * one, 0.25 * one, 0.1 * one)
        shares = self.members / self.members.sum()
        inertia = body_inertia(self.positions, self.motion.centers, shares, 0 * one, torch.ones(()).double())
        motion = joined_motion(self.motion, bodies.motion)
        solver = SubstepSolver(
            points=met.points,
            centers=motion.centers,
            inertia=joined_inertia(inertia, 1),
            materials=joined_materials(materials, torch.tensor(friction).double(), 1),
            masses=torch.cat([one, torch.full_like(one, torch.inf)], dim=1),
            rest_speed=1e-9,
            num_driven=1,
        )
        if num_substeps is not None:
            return solver.resolve_in_parts(
                motion, motion, met.static, met.between, num_substeps=num_substeps, max_depth=0.1
            )
        return solver.resolve(motion, met.static, met.between, num_iterations=num_iterations, max_depth=0.1)


def test_the_motion_of_a_part_is_that_of_its_points() -> None:
    driven = moved(even_cube(4, HALF), (0.03, -0.01, 0.02), turn=0.2)
    motion = driven_bodies(driven, torch.zeros(1, 1, 3).double()).motion
    own = torch.zeros(1, driven.positions.shape[1], dtype=torch.int64)
    assert torch.allclose(motion.carried(driven.positions, own), driven.next_positions, atol=1e-5)


def test_parts_of_several_groups_move_by_themselves() -> None:
    one, other = moved(even_cube(3, HALF), (0.03, 0, 0)), moved(even_cube(3, HALF), (0, 0, -0.02))
    both = Driven(
        torch.cat([one.positions, other.positions], dim=1),
        torch.cat([one.normals, other.normals], dim=1),
        torch.cat([one.groups, other.groups + 1], dim=1),
        next_positions=torch.cat([one.next_positions, other.next_positions], dim=1),
        next_normals=torch.cat([one.normals, other.normals], dim=1),
    )
    motion = driven_bodies(both, torch.zeros(1, 1, 3).double()).motion
    expected = torch.tensor([[[0.03, 0, 0], [0, 0, -0.02]]]).double()
    assert torch.allclose(motion.displacements, expected, atol=1e-9)


@pytest.mark.parametrize("gap", [0.001, 0.004, 0.012])
def test_a_cube_goes_as_far_as_the_plate_that_pushes_it(gap: float) -> None:
    body = OneBody(even_cube(5, HALF), (HALF + gap, 0, 0))
    resolved = body.step(moved(plate(0.0), (0.02, 0, 0)), num_iterations=12)
    assert resolved is not None and bool(resolved.touching[0, 0])
    assert resolved.step.displacements[0, 0, 0].item() == pytest.approx(0.02 - gap, abs=1e-5)
    assert resolved.step.displacements[0, 0, 1:].abs().max() < 1e-9 and resolved.step.spins[0, 0].abs().max() < 1e-9
    # It goes on as fast as the plate, not as far as it was moved.
    assert resolved.onward.displacements[0, 0, 0].item() == pytest.approx(0.02, abs=1e-5)


def test_nothing_pushes_what_is_driven() -> None:
    body = OneBody(even_ball(200, HALF), (HALF, 0, 0))
    resolved = body.step(moved(plate(0.0), (0.02, 0.01, 0)), friction=0.5)
    assert resolved is not None
    for motion in (resolved.step, resolved.onward):
        assert torch.allclose(motion.displacements[0, 1], torch.tensor([0.02, 0.01, 0]).double(), atol=1e-12)
        assert motion.spins[0, 1].abs().max() < 1e-9


def test_a_plate_that_leaves_or_stays_away_meets_nothing() -> None:
    body = OneBody(even_cube(5, HALF), (HALF + 0.001, 0, 0))
    assert body.step(moved(plate(0.0), (-0.02, 0, 0))) is None
    assert body.step(moved(plate(-0.3), (0.02, 0, 0))) is None
    beside = (plate(0.0)[0] + torch.tensor([0, 0.3, 0]).double(), plate(0.0)[1])
    assert body.step(moved(beside, (0.02, 0, 0))) is None


@pytest.mark.parametrize("step", [0.03, 0.08, 0.2, 0.5])
@pytest.mark.parametrize("shape", ["cube", "ball"])
def test_a_fast_plate_does_not_jump_over_a_body(shape: str, step: float) -> None:
    solid = even_cube(5, HALF) if shape == "cube" else even_ball(200, HALF)
    body = OneBody(solid, (HALF + 0.02, 0, 0))
    resolved = body.step(moved(plate(0.0), (step, 0, 0)), num_iterations=12)
    assert resolved is not None
    assert resolved.step.displacements[0, 0, 0].item() == pytest.approx(step - 0.02, rel=0.04)


def test_a_rod_that_strikes_a_cube_off_its_centre_turns_it() -> None:
    body = OneBody(even_cube(9, HALF), (HALF + 0.001, 0, 0))
    rod = even_ball(60, 0.008)
    struck = (rod[0] + torch.tensor([-0.008, 0.03, 0]).double(), rod[1])
    resolved = body.step(moved(struck, (0.01, 0, 0)), num_iterations=12)
    assert resolved is not None
    displacement, spin = resolved.step.displacements[0, 0], resolved.step.spins[0, 0]
    # The struck point goes as far as the rod; the centre less, and the cube turns away (clockwise from above).
    assert 0 < displacement[0] < 0.009 and spin[2] < 0
    point = displacement[0] + 0.03 * -spin[2]
    assert point.item() == pytest.approx(0.009, rel=0.1)


def test_friction_drags_a_body_along() -> None:
    body = OneBody(even_cube(5, HALF), (HALF, 0, 0))
    slides = {
        friction: body.step(moved(plate(0.0, half=0.03), (0.01, 0.01, 0)), friction=friction)
        for friction in (0.0, 0.3, 5.0)
    }
    along = {friction: float(one.step.displacements[0, 0, 1]) for friction, one in slides.items() if one is not None}
    assert along[0.0] == pytest.approx(0, abs=1e-4) and 0 < along[0.3] < along[5.0] <= 0.0101


def test_the_push_has_a_gradient_and_padding_does_not_count() -> None:
    body = OneBody(even_cube(5, HALF), (HALF + 0.004, 0, 0))
    driven = moved(plate(0.0), (0.02, 0, 0))
    plain = body.step(driven)
    junk = driven.mapped(lambda values: torch.ones_like(values[:, :3]))
    junk = replace(junk, mask=torch.zeros_like(junk.mask), groups=torch.zeros_like(junk.groups))
    names = [item.name for item in fields(Driven) if getattr(driven, item.name) is not None]
    padded = Driven(**{name: torch.cat([getattr(driven, name), getattr(junk, name)], dim=1) for name in names})
    wide = body.step(padded)
    assert plain is not None and wide is not None
    assert torch.allclose(plain.step.displacements[0, 0], wide.step.displacements[0, 0], atol=1e-12)
    body.motion = replace(body.motion, displacements=body.motion.displacements.requires_grad_())
    again = body.step(driven, friction=0.3)
    assert again is not None
    again.step.displacements.sum().backward()
    assert torch.isfinite(body.motion.displacements.grad).all()
