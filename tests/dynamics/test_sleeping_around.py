from dataclasses import dataclass, replace

import pytest
import torch

from tests.dynamics.test_sleeping import BODY, FLOOR, SETTINGS, Scripted, block, body, roll, scene, sleeping
from vpd_lightning.config import build, compose
from vpd_lightning.config.sleeping import with_sleeping
from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.hierarchical_gnn import HierarchicalGNNDynamics
from vpd_lightning.dynamics.persistence import PersistenceDynamics
from vpd_lightning.dynamics.sleeping import SleepingDynamics
from vpd_lightning.errors import NonFiniteError
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.testing import DynamicsContract, ball_particles
from vpd_lightning.types import Particles


def graph_network(**changes):
    settings = {
        **compose("train", ["dynamics=hierarchical_gnn_small", "data.folder=x", "run.folder=x"])["dynamics"],
        "feature_dim": 6,
        "hidden_dim": 12,
        "num_abstract_nodes": 16,
    }
    return build({**settings, **changes}, HierarchicalGNNDynamics, "dynamics").double().eval()


def test_where_nothing_sleeps_the_step_is_that_of_the_wrapped_dynamics():
    inner, (previous, current) = graph_network(), ball_particles(2, 60)
    keys = RandomKeys(seed=1, step=2, sample_index=[0, 1])
    wrapped = sleeping(inner, rest_speed=1e-9)
    memory = wrapped.initialize(previous, current, keys)
    before, now, other_before, other = previous, current, previous, current
    for step in range(6):
        following, memory = wrapped(before, now, memory, keys, step)
        plain, _ = inner(other_before, other, None, keys, step)
        before, now, other_before, other = now, following, other, plain
        assert torch.equal(following.positions, plain.positions) and torch.equal(following.features, plain.features)
    assert wrapped.last_awake_share == 1.0


class Counted(AbstractDynamics):
    """Stands still; notes with how many abstract nodes each step was made, and on how many particles."""

    num_abstract_nodes = 64

    def __init__(self):
        super().__init__()
        self.calls = []

    def advance(self, previous, current, keys, rollout_step, num_abstract_nodes):
        assert previous.num_particles == current.num_particles
        self.calls.append((current.num_particles, num_abstract_nodes))
        return replace(current, features=current.features + 1)

    def forward(self, previous, current, memory, keys, rollout_step):
        return self.advance(previous, current, keys, rollout_step, self.num_abstract_nodes), memory


def test_abstract_nodes_are_as_dense_among_the_awake_as_among_all():
    start = scene((block(0.6), (0, 0, 0)))  # unsupported: awake for ever
    dynamics = sleeping(Counted(), context_radius=0.7)
    _, memories = roll(dynamics, start, 6)

    total, num_block = start.num_particles, int(body(start, 1).sum())
    assert dynamics.dynamics.calls[:3] == [(total, 64)] * 3
    count, nodes = dynamics.dynamics.calls[-1]
    assert num_block < count < total and nodes == -(-64 * count // total)
    assert dynamics.last_active_share == pytest.approx(count / total)
    assert dynamics.last_awake_share == pytest.approx(num_block / total)


@pytest.mark.parametrize("freeze", [False, True])
def test_features_of_sleepers_in_sight_may_change_unless_frozen_and_all_others_stay(freeze):
    start = scene((block(0.6), (0, 0, 0)))
    states, memories = roll(sleeping(Counted(), context_radius=0.7, freeze_features=freeze), start, 8)
    change = (states[-1].features - states[5].features)[0, :, -1]
    floor = body(start, 0)[0]
    nearest = (start.positions[0, :, None] - start.positions[body(start, 1)][None]).norm(dim=-1).amin(dim=1)

    assert memories[-1].asleep[0][floor].all()
    assert (change[~floor] == 3).all()
    assert torch.equal(change[floor], torch.where(nearest <= 0.7, 0.0 if freeze else 3.0, 0.0).to(change)[floor])


@dataclass(frozen=True)
class Ticks:
    count: torch.Tensor


class WithMemory(Scripted):
    """The same motion from a dynamics that carries something: it must be given all particles."""

    def initialize(self, previous, current, keys):
        return Ticks(torch.zeros(()))

    def forward(self, previous, current, memory, keys, rollout_step):
        following, _ = super().forward(previous, current, None, keys, rollout_step)
        assert self.num_seen == int(current.mask.sum())
        return following, Ticks(memory.count + 1)


def test_around_a_dynamics_with_memory_a_scene_sleeps_as_a_whole_once_all_that_may_move_rests():
    start = scene((block(0.5), (0, 0, 0)), floor=torch.cat([FLOOR, torch.tensor([[0.0, 0.0, 5.0]])]))
    moving = body(start, 1)  # the stray point is unsupported, but it does not move
    dynamics = sleeping(WithMemory())
    states, memories = roll(dynamics, replace(start, moving=moving), 30)

    sleeping_from = next(step for step, memory in enumerate(memories) if memory.asleep.any())
    assert memories[sleeping_from].asleep.all()
    assert states[sleeping_from].positions[moving][:, 2].min() < 0.05
    assert dynamics.dynamics.num_calls == sleeping_from
    assert torch.equal(states[-1].positions, states[sleeping_from].positions)

    hovering = replace(scene((block(0.6), (0, 0, 0))), moving=body(scene((block(0.6), (0, 0, 0))), 1))
    assert not roll(sleeping(WithMemory(gravity=0.0)), hovering, 20)[1][-1].asleep.any()


def test_members_around_a_dynamics_with_memory_stay_put_while_another_one_goes_on():
    rest, fall = scene((block(0.0), (0, 0, 0))), scene((block(3.0), (0, 0, 0)))
    together = Particles(torch.cat([rest.positions, fall.positions]), torch.cat([rest.features, fall.features]))
    states, memories = roll(sleeping(WithMemory()), together, 10)

    assert memories[4].asleep[0].all() and not memories[4].asleep[1].any()
    for state in states[4:]:
        assert torch.equal(state.positions[0], states[4].positions[0])
        assert torch.equal(state.features[0], states[4].features[0])
    assert torch.equal(states[-1].positions[1], roll(Scripted(), fall, 10, "none")[0][-1].positions[0])


def test_return_to_rest_takes_back_what_was_drifted_while_resting():
    class Creep(AbstractDynamics):
        def forward(self, previous, current, memory, keys, rollout_step):
            return replace(current, positions=current.positions + 0.003), memory

    start = scene()
    states, memories = roll(sleeping(Creep(), return_to_rest=True), start, 6)

    assert memories[3].asleep.all() and not torch.equal(states[2].positions, start.positions)
    assert torch.equal(states[3].positions, start.positions)
    assert not torch.equal(roll(sleeping(Creep()), start, 6)[0][-1].positions, start.positions)


def test_nothing_sleeps_in_training_unless_configured():
    start = scene((block(0.0), (0, 0, 0)))

    assert not roll(sleeping().train(), start, 6)[1][-1].asleep.any()
    assert roll(sleeping(in_training=True).train(), start, 6)[1][-1].asleep.all()


def test_gradients_reach_the_weights_and_features_through_a_scene_that_is_partly_asleep():
    inner = graph_network(feature_dim=5, location_scale=0.02)
    dynamics = sleeping(inner, rest_speed=0.05, rest_drift=0.4, location_scale=0.1, return_to_rest=True)
    start = scene((block(0.6), (0, 0, 0)))
    start = replace(start, features=start.features.clone().requires_grad_())
    states, memories = roll(dynamics, start, 5)

    states[-1].positions.sum().backward()
    assert start.features.grad.isfinite().all() and start.features.grad.any()
    assert all(p.grad.isfinite().all() for p in inner.parameters() if p.grad is not None)


@pytest.mark.parametrize("shape", [(2, 0), (0, 5), (1, 1)])
def test_no_particle_no_member_and_one_particle(shape):
    empty = Particles(torch.zeros(*shape, 3, dtype=torch.float64), torch.zeros(*shape, 5, dtype=torch.float64))
    states, memories = roll(sleeping(PersistenceDynamics()), empty, 5)

    assert states[-1].positions.shape == (*shape, 3)
    assert not memories[-1].asleep.any()  # one particle has nothing to rest on


def test_positions_that_are_not_numbers_are_refused_by_name():
    class Burst(AbstractDynamics):
        def forward(self, previous, current, memory, keys, rollout_step):
            bad = (current.features[..., BODY] == 1) & (rollout_step == 6)
            return replace(current, positions=current.positions.masked_fill(bad[..., None], float("nan"))), memory

    with pytest.raises(NonFiniteError):
        roll(sleeping(Burst()), scene((block(0.6), (0, 0, 0))), 10)


def test_state_dict_is_that_of_the_wrapped_dynamics_and_loads_both_ways():
    inner, other = graph_network(), graph_network()
    wrapped = sleeping(other)
    holder = torch.nn.ModuleDict({"dynamics": wrapped})

    assert list(wrapped.state_dict()) == list(inner.state_dict())
    assert list(holder.state_dict()) == [f"dynamics.{name}" for name in inner.state_dict()]
    holder.load_state_dict({f"dynamics.{name}": value for name, value in inner.state_dict().items()})
    assert all(torch.equal(a, b) for a, b in zip(inner.parameters(), other.parameters(), strict=True))
    fresh = graph_network()
    fresh.load_state_dict(wrapped.state_dict())
    assert all(torch.equal(a, b) for a, b in zip(inner.parameters(), fresh.parameters(), strict=True))
    with pytest.raises(RuntimeError, match="Missing"):
        wrapped.load_state_dict({})


@pytest.mark.parametrize("name", ["hierarchical_gnn_small", "inertial"])
def test_a_trained_models_configuration_takes_sleeping_afterwards(name):
    config = compose("train", ["experiment=demo", f"dynamics={name}"])
    changed = with_sleeping(config, {"rest_steps": 4})
    dynamics = build(changed["dynamics"], AbstractDynamics, "dynamics")

    assert config["dynamics"] == changed["dynamics"]["dynamics"] and "rest_steps" not in config["dynamics"]
    assert dynamics.rest_steps == 4 and dynamics.wake_radius == config["scene"]["r_s"]
    dynamics.load_state_dict(build(config["dynamics"], AbstractDynamics, "dynamics").state_dict())
    again = with_sleeping(changed, {"rest_steps": 5})["dynamics"]
    assert again == {**changed["dynamics"], "rest_steps": 5}


def test_paper_configuration_does_not_sleep():
    assert "sleeping" not in compose("train", ["experiment=mujoco_block", "run.folder=x"])["dynamics"]["_target_"]


@pytest.mark.parametrize("name", ["rest_speed", "rest_drift", "wake_radius", "context_radius", "link_radius"])
def test_lengths_must_be_positive(name):
    with pytest.raises(ValueError, match=name):
        sleeping(**{name: 0.0})


class TestAroundGraphNetwork(DynamicsContract):
    departures = {"test_order_of_particles_does_not_matter": "abstract nodes are drawn among the slots of particles"}

    def build(self):
        return SleepingDynamics(dynamics=graph_network(r_s=0.4, r_a_s=0.8), **SETTINGS)


class TestAroundPersistence(DynamicsContract):
    num_steps = 6

    def build(self):
        return SleepingDynamics(dynamics=PersistenceDynamics(), **SETTINGS)
