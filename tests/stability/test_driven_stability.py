"""Dynamics with something driven: fast parts, hard scenes, far from the origin. Metres and steps."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.dynamics.solids import even_cube
from tests.stability.hard_scenes import SPACING, HardScene, Mode, is_finite
from tests.stability.known_faults import known_fault
from tests.stability.stages import stage
from tests.stability.test_dynamics_stability import pair_at, rolled
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Driven, Particles

HALF, GAP = 0.15, 0.02
KEYS = RandomKeys(seed=1, step=2, sample_index=[0])


def given(points: Tensor, step: Tensor, like: Particles) -> Driven:
    """Points that face +x and go by ``step``, in the precision of the particles."""
    positions = points.to(like.positions)[None]
    normals = torch.tensor([1.0, 0.0, 0.0]).to(like.positions).expand_as(positions)
    groups = torch.zeros(positions.shape[:2], dtype=torch.int64, device=positions.device)
    return Driven(positions, normals, groups, next_positions=positions + step.to(like.positions), next_normals=normals)


@pytest.mark.parametrize("step", [0.05, 0.2, 0.5])
@pytest.mark.parametrize("offset", [0.0, 1024.0])
def test_a_fast_driven_plate_jumps_over_nothing(step: float, offset: float, mode: Mode, device: torch.device):
    dynamics = stage(
        "dynamics", "inertial", mode, device,
        has_driven=True, is_soft=False, num_contact_iterations=12, num_probes=256, guess_hidden=False,
    ).eval()  # fmt: skip
    away = torch.tensor([offset, 0.0, 0.0], dtype=torch.float64)
    positions, normals = (values.to(device, mode.dtype)[None] for values in even_cube(6, HALF))
    features = torch.rand(1, positions.shape[1], 8, generator=torch.Generator().manual_seed(0))
    cube = Particles(
        positions + away.to(positions),
        features.to(positions)[..., : dynamics.materials.network[0].normalized_shape[0]],
        colors=torch.full_like(positions, 0.5),
        moving=torch.ones(positions.shape[:2], dtype=torch.bool, device=device),
        normals=normals,
    )
    axis = (torch.arange(9, dtype=torch.float64) + 0.5) / 9 * 2 - 1
    y, z = (HALF * values.flatten() for values in torch.meshgrid(axis, axis, indexing="ij"))
    plate = torch.stack([torch.full_like(y, -HALF - GAP), y, z], dim=-1)
    cube = replace(cube, driven=given(plate + away, torch.tensor([step, 0.0, 0.0]), cube))

    _, following = rolled(dynamics, (replace(cube, driven=None), cube), mode, device, 1)

    assert is_finite(following.positions)
    moved = (following.positions - cube.positions).detach().double()[0]
    # Noisy weights push, too: by a few hundredths of a metre.
    assert float(moved[:, 0].mean()) == pytest.approx(step - GAP, abs=0.03)
    behind = (offset - HALF - GAP + step) - following.positions.detach().double()[0, :, 0].min()
    assert float(behind) < 0.06, "the whole cube is in front of the plate"


@pytest.mark.parametrize("option", ["inertial", "hierarchical_gnn"])
def test_states_and_gradients_are_finite_with_something_driven(
    option: str, scene: HardScene, mode: Mode, device: torch.device, request: pytest.FixtureRequest
):
    is_wide = request.node.callspec.params["scene"] in ("all_scales_at_once", "clusters_1e6_apart")
    known_fault(request, "negative_squares", is_wide and option == "inertial" and mode.dtype == torch.float32)
    dynamics = stage("dynamics", option, mode, device, scene.spacing / SPACING, has_driven=True)
    previous, current = pair_at(scene.points, mode, device, scene.spacing)
    if current.num_particles == 0:
        pytest.skip("nothing to push")
    places = scene.points[:12] - 0.2 * scene.spacing
    driven = given(places, torch.tensor([0.5, 0.1, 0.0]) * scene.spacing, current)
    inputs = [value.clone().requires_grad_() for value in (current.positions, current.features)]
    current = replace(current, positions=inputs[0], features=inputs[1], driven=driven)

    _, following = rolled(dynamics, (previous, current), mode, device, 1)
    weights = [p for p in dynamics.parameters() if p.requires_grad]
    total = ((following.positions - inputs[0]) / scene.spacing).sum() + following.features.sum()
    gradients = torch.autograd.grad(total, [*inputs, *weights], materialize_grads=True)

    assert is_finite(following.positions, following.features)
    assert is_finite(*gradients)
