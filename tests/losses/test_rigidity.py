"""The rigidity loss against values computed by hand, and against a plain loop over pairs."""

from dataclasses import replace

import pytest
import torch

from vpd_lightning.losses.rigidity import RigidityLoss
from vpd_lightning.testing.scenes import video_batch
from vpd_lightning.types import Particles, SimulatorOutput

RADIUS, SOFTNESS = 0.12, 0.3


def loss_of(num_particles: int = 50, num_neighbors: int = 50, **changes: float) -> RigidityLoss:
    settings = {"weight": 1.0, "radius": RADIUS, "softness": SOFTNESS, **changes}
    return RigidityLoss(num_particles=num_particles, num_neighbors=num_neighbors, **settings)


def cloud(count: int = 40, batch: int = 2) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return 0.2 * torch.rand(batch, count, 3, generator=generator, dtype=torch.float64)


def output_of(*positions: torch.Tensor) -> SimulatorOutput:
    return SimulatorOutput(None, [Particles(p, torch.zeros(*p.shape[:2], 1, dtype=p.dtype)) for p in positions])


def turned(positions: torch.Tensor, angle: float) -> torch.Tensor:
    cos, sin = (part(torch.tensor(angle, dtype=torch.float64)) for part in (torch.cos, torch.sin))
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    rotation = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one]).view(3, 3)
    return positions @ rotation.mT


def test_a_rigid_motion_costs_nothing() -> None:
    start = cloud()
    value = loss_of()(output_of(start, turned(start, 0.3) + 0.1, turned(start, 1.2) - 0.4), video_batch(2))
    assert float(value) < 1e-20


@pytest.mark.parametrize("growth", [0.1, -0.2])
def test_a_body_that_grows_or_shrinks(growth: float) -> None:
    start = cloud()
    value = loss_of()(output_of(start, start, (1 + growth) * start), video_batch(2))
    assert float(value) == pytest.approx(0.5 * growth**2 / (growth**2 + SOFTNESS**2))


def test_a_body_that_leaves_the_floor_costs_a_bounded_amount() -> None:
    start = cloud()
    lifted = start.clone()
    lifted[:, :20, 2] += 50.0
    lifted.requires_grad_()
    value = loss_of()(output_of(start, lifted), video_batch(2))
    (gradient,) = torch.autograd.grad(value, lifted)
    assert 0 < float(value) < 1 and gradient.abs().max() < 1e-6


def test_all_pairs_are_those_of_a_plain_loop() -> None:
    start, noise = cloud(), cloud().roll(1, 1)
    states = [start, start + 0.1 * noise, start + 0.3 * noise]
    total, count = [0.0, 0.0], 0
    for member in range(2):
        for i in range(40):
            for j in range(40):
                before = float((start[member, i] - start[member, j]).norm())
                if not RADIUS / 6 < before < RADIUS:
                    continue
                count += 1
                for step in (1, 2):
                    after = float((states[step][member, i] - states[step][member, j]).norm())
                    change = (after / before - 1) ** 2
                    total[step - 1] += change / (change + SOFTNESS**2)
    value = loss_of()(output_of(*states), video_batch(2))
    assert float(value) == pytest.approx(sum(total) / (2 * count), rel=1e-12)


def test_pairs_are_of_what_moves_and_are_drawn_again_by_the_same_keys() -> None:
    start = cloud()
    moved = start.clone()
    moved[:, :5] *= 1.5  # of five particles, which are the ones chosen
    few = loss_of(num_particles=5, num_neighbors=3)
    batch = video_batch(2)
    value = few(output_of(start, moved), batch)
    assert float(value) > 0.05 and few(output_of(start, moved), batch) == value
    later = replace(batch, keys=replace(batch.keys, step=batch.keys.step + 1))
    assert few(output_of(start, moved), later) != value


def test_padding_a_single_step_and_lone_particles_cost_nothing() -> None:
    assert float(loss_of()(output_of(cloud()), video_batch(2))) == 0
    assert float(loss_of()(output_of(), video_batch(2))) == 0
    far = 100 * cloud()
    assert float(loss_of()(output_of(far, 2 * far), video_batch(2))) == 0

    padded = torch.cat([cloud(), torch.full((2, 3, 3), torch.nan, dtype=torch.float64)], dim=1).requires_grad_()
    mask = torch.arange(43).expand(2, -1) < 40
    states = [Particles(scale * padded, torch.zeros(2, 43, 1), mask) for scale in (1.0, 1.1)]
    value = loss_of()(SimulatorOutput(None, states), video_batch(2))
    assert float(value) == pytest.approx(0.01 / (0.01 + SOFTNESS**2))
    value.backward()
    assert padded.grad is not None and torch.isfinite(padded.grad[mask]).all()


def test_particles_that_meet_have_a_finite_gradient() -> None:
    start = cloud()
    met = start.mean(dim=1, keepdim=True).expand_as(start).clone().requires_grad_()
    loss_of()(output_of(start, met), video_batch(2)).backward()
    assert met.grad is not None and torch.isfinite(met.grad).all()


@pytest.mark.parametrize("changes", [{"weight": -1.0}, {"radius": 0.0}, {"softness": 0.0}, {"num_particles": 0}])
def test_wrong_settings_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        loss_of(**changes)  # type: ignore[arg-type]
