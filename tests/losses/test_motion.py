"""The motion loss against loops, and where it pulls."""

import math
from dataclasses import replace

import pytest
import torch

from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.motion import MotionLoss
from vpd_lightning.testing.scenes import ball_particles, video_batch
from vpd_lightning.types import SimulatorOutput

SETTINGS = {"weight": 1.0, "scales": [0.05, 0.1, 0.2], "color_scale": 0.15, "num_particles": 256}
NUM_STEPS, NUM_SEEN = 2, 9


def loss(**changes):
    return MotionLoss(**{**SETTINGS, **changes})


def made(size=2, seed=0):
    """States of a ball that moves on, and points seen of it at each step, some slots of them padding."""
    generator = torch.Generator().manual_seed(seed)
    particles = ball_particles(size)[1]
    mask = torch.rand(particles.mask.shape, generator=generator) < 0.9
    particles = replace(particles, mask=mask, moving=particles.moving & mask)
    step = torch.tensor([0.03, 0.02, -0.02], dtype=torch.float64)
    states = [replace(particles, positions=particles.positions + (1 + t) * step) for t in range(NUM_STEPS)]
    center = particles.positions[:, None, :1] + step
    seen = center + 0.1 * torch.randn(size, NUM_STEPS, NUM_SEEN, 3, generator=generator, dtype=torch.float64)
    auxiliary = {
        "future_positions": seen,
        "future_colors": torch.rand(seen.shape, generator=generator, dtype=torch.float64),
        "future_mask": torch.rand(seen.shape[:-1], generator=generator) < 0.8,
    }
    return SimulatorOutput(None, states, auxiliary)


def by_loops(output, member, scales, color_scale, num_particles):
    """The loss of one batch member, point by point."""
    first, costs = output.states[0], []
    chosen = [slot for slot in range(first.mask.shape[1]) if first.mask[member, slot] and first.moving[member, slot]]
    chosen = chosen[:num_particles]
    for scale in scales:
        forwards, backwards = [], []
        for step, state in enumerate(output.states):
            seen_mask = output.auxiliary["future_mask"][member, step]
            seen = [point for point in range(len(seen_mask)) if seen_mask[point]]

            def kernel(slot, point, state=state, step=step, scale=scale):
                gap = state.positions[member, slot] - output.auxiliary["future_positions"][member, step, point]
                tone = first.colors[member, slot] - output.auxiliary["future_colors"][member, step, point]
                distance, tint = float((gap**2).sum()), float((tone**2).sum())
                return math.exp(-distance / (2 * scale**2) - tint / (2 * color_scale**2))

            forwards += [-math.log(sum(kernel(slot, point) for point in seen) + 0.05) for slot in chosen]
            backwards += [-math.log(sum(kernel(slot, point) for slot in chosen) + 0.05) for point in seen]
        costs.append(sum(forwards) / max(1, len(forwards)) + sum(backwards) / max(1, len(backwards)))
    return sum(costs) / len(costs)


@pytest.mark.parametrize("num_particles", [256, 5])
def test_value_is_that_of_loops(num_particles):
    output, batch = made(), video_batch(2)
    expected = [by_loops(output, member, SETTINGS["scales"], 0.15, num_particles) for member in range(2)]

    value = loss(num_particles=num_particles)(output, batch)

    assert value.shape == () and value.item() == pytest.approx(sum(expected) / 2, rel=1e-9)


def test_autocast_leaves_the_geometry_alone():
    output, batch = made(), video_batch(2)
    single = {name: v.float() if v.is_floating_point() else v for name, v in output.auxiliary.items()}  # autocast's own
    output = replace(output, states=[state.to(torch.float32) for state in output.states], auxiliary=single)

    value = loss()(output, batch)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        lowered = loss()(output, batch)

    assert torch.equal(lowered, value)


def with_leaves(output):
    leaves = [state.positions.clone().requires_grad_() for state in output.states]
    return replace(output, states=[replace(s, positions=p) for s, p in zip(output.states, leaves, strict=True)]), leaves


def test_only_what_may_move_and_is_there_is_pulled():
    output, leaves = with_leaves(made())
    loss()(output, video_batch(2)).backward()

    first = output.states[0]
    for leaf in leaves:
        assert torch.isfinite(leaf.grad).all()
        assert (leaf.grad[~(first.mask & first.moving)] == 0).all()
        assert (leaf.grad[first.mask & first.moving].abs().sum(-1) > 0).all()


def test_where_nothing_is_seen_nothing_is_pulled():
    output = made()
    nothing = dict(output.auxiliary, future_mask=torch.zeros_like(output.auxiliary["future_mask"]))
    output, leaves = with_leaves(replace(output, auxiliary=nothing))

    value = loss()(output, video_batch(2))
    value.backward()

    assert value.item() == pytest.approx(-math.log(0.05))
    assert all((leaf.grad == 0).all() for leaf in leaves)


def test_without_anything_that_may_move_there_is_no_pull_and_nothing_infinite():
    output = made()
    states = [replace(state, moving=torch.zeros_like(state.moving)) for state in output.states]
    output, leaves = with_leaves(replace(output, states=states))

    value = loss()(output, video_batch(2))
    value.backward()

    assert torch.isfinite(value) and all((leaf.grad == 0).all() for leaf in leaves)


@pytest.mark.parametrize("distance", [0.02, 0.1, 0.4])
def test_the_pull_points_to_where_the_body_is_seen(distance):
    particles = ball_particles(1, num_particles=60)[1]
    body = particles.moving[0]
    way = torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64)
    way = way / way.norm()
    seen = (particles.positions[0, body] + distance * way)[None, None]
    auxiliary = {
        "future_positions": seen,
        "future_colors": particles.colors[0, body][None, None],
        "future_mask": torch.ones(seen.shape[:-1], dtype=torch.bool),
    }
    output, (leaf,) = with_leaves(SimulatorOutput(None, [particles], auxiliary))

    loss()(output, video_batch(1)).backward()

    pull = -leaf.grad[0].sum(dim=0)
    assert pull @ way / pull.norm() > 0.9


def test_at_its_place_the_body_costs_least():
    particles = ball_particles(1, num_particles=60)[1]
    body = particles.moving[0]
    seen = particles.positions[0, body][None, None]
    auxiliary = {
        "future_positions": seen,
        "future_colors": particles.colors[0, body][None, None],
        "future_mask": torch.ones(seen.shape[:-1], dtype=torch.bool),
    }

    def cost(shift):
        moved = replace(particles, positions=particles.positions + torch.tensor([shift, 0.0, 0.0]).double())
        return loss()(SimulatorOutput(None, [moved], auxiliary), video_batch(1)).item()

    costs = [cost(shift) for shift in (0.0, 0.03, 0.06, 0.12, 0.24, 0.5)]
    assert costs == sorted(costs)
    assert cost(1000.0) == pytest.approx(-2 * math.log(0.05))  # bounded, whatever is predicted


def test_a_batch_is_the_mean_of_its_members():
    """However many points each of them has: a training on several devices equals one on a single device."""
    output, batch = made(3), video_batch(3)
    few = output.auxiliary["future_mask"].clone()
    few[0, :, 2:] = False
    output = replace(output, auxiliary=dict(output.auxiliary, future_mask=few))

    def member(index):
        states = [state.mapped(lambda values: values[index : index + 1]) for state in output.states]
        auxiliary = {name: value[index : index + 1] for name, value in output.auxiliary.items()}
        return loss()(SimulatorOutput(None, states, auxiliary), video_batch(1)).item()

    assert loss()(output, batch).item() == pytest.approx(sum(member(index) for index in range(3)) / 3, rel=1e-9)


@pytest.mark.parametrize("missing", ["future", "moving", "colors"])
def test_what_is_missing_is_named_with_what_to_set(missing):
    output = made()
    if missing == "future":
        output = replace(output, auxiliary={})
    else:
        output = replace(output, states=[replace(state, **{missing: None}) for state in output.states])

    with pytest.raises(ConfigError, match="data.load_future=true"):
        loss()(output, video_batch(2))


@pytest.mark.parametrize(
    "changes",
    [{"weight": -1.0}, {"scales": []}, {"scales": [0.1, 0.0]}, {"color_scale": 0.0}, {"num_particles": 0}],
)
def test_wrong_settings_are_refused(changes):
    with pytest.raises(ValueError, match="must"):
        loss(**changes)
