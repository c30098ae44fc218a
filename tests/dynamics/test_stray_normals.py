"""One stray particle of the floor, as noisy depth has them, throws no body aside."""

from dataclasses import replace

import pytest
import torch

from tests.dynamics.solids import cube
from tests.dynamics.test_inertial import dynamics, scene
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
