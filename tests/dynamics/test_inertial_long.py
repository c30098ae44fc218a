"""Five hundred steps of the inertial dynamics: nothing grows, creeps or comes apart."""

import pytest
import torch

from tests.dynamics.solids import UP, cube, rotation_about
from tests.dynamics.test_inertial import dynamics, fall, floor, pairwise
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles

NUM_STEPS = 500
LENGTH = 60  # particles of a body


def scene(bodies, dtype):
    """Bodies (points, colours, normals, place) above a floor, as it is now."""
    ground = floor(60)
    positions = torch.cat([*(body[0] + torch.tensor(body[3]).double() for body in bodies), ground])
    generator = torch.Generator().manual_seed(0)
    return Particles(
        positions=positions[None],
        features=torch.rand(1, len(positions), 4, generator=generator, dtype=torch.float64),
        colors=torch.cat([*(body[1] for body in bodies), torch.full_like(ground, 0.7)])[None],
        moving=(torch.arange(len(positions)) < len(positions) - 60)[None],
        normals=torch.cat([*(body[2] for body in bodies), UP.expand(60, 3)])[None],
    ).to(dtype)


def rolled(model, previous, current):
    """The states of every tenth step."""
    keys, states = RandomKeys.fixed(1), []
    with torch.no_grad():
        memory = model.initialize(previous, current, keys)
        for step in range(NUM_STEPS):
            following, memory = model(previous, current, memory, keys, step)
            previous, current = current, following
            if step % 10 == 9:
                states.append(following)
    return states


@pytest.fixture(scope="module")
def landed():
    """A tilted cube thrown sideways on a floor; rigid, with friction, in single precision as in use."""
    points, colors, normals = cube(LENGTH, seed=3)
    turn = rotation_about([1, 2, 0], 0.4)
    body = (points @ turn.T, colors, normals @ turn.T)
    now = scene([(*body, (0.0, 0.0, 0.4))], torch.float32)
    before = scene([(*body, (-0.03, 0.01, 0.42))], torch.float32)
    model = fall(dynamics(num_probes=LENGTH, num_bodies=1)).to(torch.float32)
    return now, rolled(model, before, now)


@pytest.mark.slow
def test_everything_stays_finite_and_what_is_static_stays_exactly(landed):
    now, states = landed
    still = ~now.moving[0]
    for state in states:
        assert torch.isfinite(state.positions).all() and torch.isfinite(state.features).all()
        assert torch.equal(state.positions[0, still], now.positions[0, still])
        assert torch.equal(state.mask, now.mask)


@pytest.mark.slow
def test_a_rigid_body_keeps_its_size(landed):
    now, states = landed
    body = now.moving[0]
    size = pairwise(now.positions[0, body].double())
    for state in states:
        ratio = (pairwise(state.positions[0, body].double()) / size)[size > 0.05]
        # Rotations are orthonormal by construction; rounding of a float32 walk of 500 steps stays below this.
        assert (ratio - 1).abs().max() < 1e-4


@pytest.mark.slow
def test_it_comes_to_rest_on_the_floor_at_its_true_height(landed):
    now, states = landed
    body = now.moving[0]
    last = states[-1].positions[0, body]

    assert (last - states[-10].positions[0, body]).norm(dim=-1).max() < 0.01
    assert last[:, 2].min() > -0.015
    assert 0.26 < last[:, 2].max() < 0.34  # 30 cm on a face; 60 points show neither corners nor edges
    assert last[:, :2].abs().max() < 1.5  # friction stopped it within sight
