"""Stray particles, as noisy depth has them, throw no body aside: one of the floor, and some taken for moving."""

from dataclasses import replace

import pytest
import torch

from tests.dynamics.solids import cube
from tests.dynamics.test_inertial import dynamics, random_toss, scene
from vpd_lightning.dynamics.inertial import dynamics as module
from vpd_lightning.randomness import RandomKeys

STRAY = -20
"""One of the floor's particles, which are the last fifty."""


def displacement(*, is_stray: bool) -> torch.Tensor:
    """Return by how much a cube that hangs still above a floor moves in the first step."""
    positions, colors, normals = cube(200, seed=3)
    world = scene(positions, colors, normals)
    if is_stray:  # a metre beside the cube, and its plane cuts the cube
        places, facing = world.positions.clone(), world.normals.clone()
        places[0, STRAY] = torch.tensor([0.02, 1.0, 0.1])
        facing[0, STRAY] = torch.tensor([-1.0, 0.0, 0.0])
        # All that is nearer to the cube is hidden, as it is by a body that is near.
        mask = world.mask.clone()
        mask[0, 200:] = False
        mask[0, STRAY:] = True
        far = torch.linspace(-3, 3, 19, dtype=torch.float64)
        places[0, STRAY + 1 :] = torch.stack([3 + 0 * far, far, 0 * far], dim=-1)
        world = replace(world, positions=places, normals=facing, mask=mask)
    model = dynamics().eval()
    keys = RandomKeys.fixed(1)
    with torch.no_grad():
        following, _ = model(world, world, model.initialize(world, world, keys), keys, 0)
    return (following.positions - world.positions)[0, :200].mean(dim=0)


def test_a_stray_particle_is_no_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    assert displacement(is_stray=True).norm() < 1e-3
    monkeypatch.setattr(module, "trusted_normals", lambda positions, normals, mask: normals)
    assert displacement(is_stray=True)[0].abs() > 0.01, "the scene would show a wall"


def test_a_floor_acts_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    found = displacement(is_stray=False)
    monkeypatch.setattr(module, "trusted_normals", lambda positions, normals, mask: normals)
    assert torch.equal(displacement(is_stray=False), found)


def step_of_a_tossed_cube(num_strays: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return by how much each of the cube's particles, and each stray ten metres away, moves in the first step."""
    before, now, _ = random_toss(1)
    previous, current = scene(*before), scene(*now)
    places, moving = current.positions.clone(), current.moving.clone()
    strays = slice(len(now[0]), len(now[0]) + num_strays)
    places[0, strays] += torch.tensor([10.0, 0.0, 3.0])
    moving[0, strays] = True
    current = replace(current, positions=places, moving=moving)
    model, keys = dynamics().eval(), RandomKeys.fixed(1)
    with torch.no_grad():
        following, _ = model(previous, current, model.initialize(previous, current, keys), keys, 0)
    moved = (following.positions - current.positions)[0]
    return moved[: len(now[0])], moved[strays]


def test_what_is_far_from_a_body_does_not_move_with_it() -> None:
    alone, _ = step_of_a_tossed_cube(0)
    found, strays = step_of_a_tossed_cube(5)

    assert alone.norm(dim=-1).mean() > 0.02
    assert (found - alone).norm(dim=-1).max() < 2e-3
    assert not strays.any()
