"""What the simulator relies on in a dynamics."""

from dataclasses import fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.testing import particle_sets as sets
from vpd_lightning.testing.contract import (
    Contract,
    assert_finite,
    assert_gradients,
    assert_precision,
    assert_same,
    describe_case,
    disturb_global_randomness,
    global_randomness_untouched,
    may_depart,
    summed,
    unchanged,
)
from vpd_lightning.testing.scenes import FEATURE_DIM, ball_particles, keys_for
from vpd_lightning.types import Particles

State = tuple[Tensor, Tensor]


class DynamicsContract(Contract):
    """Subclass as ``class TestMine(DynamicsContract)`` and return the dynamics from ``build``.

    Build it for features of ``feature_dim`` numbers and a scene of a metre: a ball 30 cm wide that moves 4 cm per
    step over a floor (``ball_particles``). Every particle carries colours, normals and whether it may move;
    ``needs_observations``: the dynamics cannot do without them.
    """

    feature_dim: int = FEATURE_DIM
    needs_observations: bool = False
    num_steps: int = 3

    def build(self) -> AbstractDynamics:
        """Return a new dynamics at a small size."""
        return super().build()

    def particles(self, batch_size: int = 2, num_particles: int = 40) -> tuple[Particles, Particles]:
        """Return the (previous, current) particles of the checks; override for another scene."""
        previous, current = ball_particles(batch_size, num_particles, self.feature_dim)
        return previous.to(self.device), current.to(self.device)

    def roll(
        self, dynamics: AbstractDynamics, previous: Particles, current: Particles, keys: RandomKeys | None = None
    ) -> list[Particles]:
        """Roll out ``num_steps`` steps as the simulator does."""
        keys = keys or keys_for(len(current.positions))
        memory, states = dynamics.initialize(previous, current, keys), []
        for rollout_step in range(self.num_steps):
            following, memory = dynamics(previous, current, memory, keys, rollout_step)
            previous, current = current, following
            states.append(following)
        return states

    def test_keeps_slots_mask_and_precision(self) -> None:
        for dtype in (torch.float32, torch.float64):
            previous, current = (particles.to(dtype) for particles in self.particles())
            current = sets.only_valid(current, 30)
            for state in self.roll(self.built(dtype), previous, current):
                assert state.positions.shape == current.positions.shape
                assert state.features.shape == current.features.shape
                assert torch.equal(state.mask, current.mask), "a step must not change which slots are padding"
                assert_precision(state, dtype)
                assert_finite(state, "state")

    def test_carries_observations_along(self) -> None:
        previous, current = self.particles()
        states = self.roll(self.built(), previous, current)
        for name in ("colors", "moving", "normals"):
            assert getattr(states[-1], name) is not None, f"{name} were lost; return dataclasses.replace(current, ...)"

    def test_observations_are_needed_only_if_declared(self) -> None:
        previous, current = (replace(one, colors=None, moving=None, normals=None) for one in self.particles())
        try:
            states = self.roll(self.built(), previous, current)
        except ValueError:
            assert self.needs_observations, "refuses particles without colours and normals: set needs_observations"
        else:
            assert not self.needs_observations, "works without observations: unset needs_observations"
            assert_finite(states, "states")

    def test_a_batch_equals_its_members(self) -> None:
        dynamics, (previous, current) = self.built(), self.particles(3)
        # Members with different padding must not influence each other in a batch.
        current = replace(current, mask=torch.cat([current.mask[:2], sets.only_valid(current, 25).mask[2:]]))
        together = self.roll(dynamics, previous, current)[-1]
        for index in range(3):
            keys = replace(keys_for(3), sample_index=[index])
            alone = self.roll(dynamics, sets.member(previous, index), sets.member(current, index), keys)[-1]
            assert_same(_valid(alone), _valid(sets.member(together, index)), self.tolerance)

    def test_padding_changes_nothing(self) -> None:
        dynamics, (previous, current) = self.built(), self.particles()
        plain = self.roll(dynamics, previous, current)[-1]
        for where, padded in sets.PADDINGS.items():
            wide = self.roll(dynamics, padded(previous), padded(current))[-1]
            with describe_case(f"with padding {where}"):
                assert_same(_valid(sets.without_padding(wide)), _valid(plain), self.tolerance)

    @may_depart
    def test_order_of_particles_does_not_matter(self) -> None:
        dynamics, (previous, current) = self.built(), self.particles()
        generator = torch.Generator().manual_seed(4)
        orders = [torch.randperm(p.num_particles, generator=generator).to(self.device) for p in (previous, current)]
        plain = self.roll(dynamics, previous, current)[-1]
        other = self.roll(dynamics, sets.reordered(previous, orders[0]), sets.reordered(current, orders[1]))[-1]
        assert_same(_valid(other), _valid(sets.reordered(plain, orders[1])), self.tolerance)

    @may_depart
    def test_moving_the_world_moves_the_prediction(self) -> None:
        dynamics, (previous, current) = self.built(), self.particles()
        plain = self.roll(dynamics, previous, current)[-1]
        moved = self.roll(dynamics, sets.shifted(previous), sets.shifted(current))[-1]
        assert_same(_valid(moved), _valid(sets.shifted(plain)), self.tolerance)

    def test_same_keys_give_the_same_prediction_and_global_randomness_is_untouched(self) -> None:
        dynamics = self.built().train()
        with global_randomness_untouched():
            first = self.roll(dynamics, *self.particles())
        disturb_global_randomness()
        assert_same(self.roll(dynamics, *self.particles()), first)

    def test_inputs_and_memory_stay_as_they_are(self) -> None:
        dynamics, (previous, current), keys = self.built(), self.particles(), keys_for(2)
        with unchanged(previous, current):
            memory = dynamics.initialize(previous, current, keys)
        with unchanged(previous, current, memory):
            first = dynamics(previous, current, memory, keys, 0)
        assert_same(dynamics(previous, current, memory, keys, 0), first)

    def test_memory_is_plain_and_can_be_rebuilt_in_the_middle_of_a_rollout(self) -> None:
        dynamics, (previous, current), keys = self.built(), self.particles(), keys_for(2)
        memory = dynamics.initialize(previous, current, keys)
        for _ in range(2):
            _assert_plain(memory)
            assert_same(dynamics.initialize(previous, current, keys), memory)
            following, after = dynamics(previous, current, memory, keys, 0)
            _assert_plain(after)
            # An edit: some predicted particles are gone, and what is left must be a scene like any other.
            previous, current = sets.first(current, 30), sets.first(following, 30)
            memory = dynamics.initialize(previous, current, keys)
        state, _ = dynamics(previous, current, memory, keys, 0)
        assert state.positions.shape == current.positions.shape
        assert_finite(state, "state")

    def test_previous_and_current_may_differ_in_number(self) -> None:
        previous, current = self.particles()
        states = self.roll(self.built(), sets.first(previous, 25), current)
        assert states[-1].positions.shape == current.positions.shape
        assert_finite(states, "states")

    def test_every_weight_and_the_features_get_a_finite_gradient(self) -> None:
        dynamics, (previous, current) = self.built().train(), self.particles()
        current = replace(current, features=current.features.requires_grad_())
        summed([_valid(state) for state in self.roll(dynamics, previous, current)]).backward()
        assert_gradients(dynamics)
        gradient = current.features.grad
        assert gradient is not None and gradient.any(), "no gradient reaches the features, so the encoder cannot learn"
        assert_finite(gradient, "gradient of the features")

    def test_no_particle_and_one_particle(self) -> None:
        dynamics = self.built().train()
        previous, current = self.particles()
        scenes = {
            "no valid particle": (sets.only_valid(previous, 0), sets.only_valid(current, 0)),
            "one valid particle": (sets.only_valid(previous, 1), sets.only_valid(current, 1)),
            "one slot": (sets.first(previous, 1), sets.first(current, 1)),
            "no slot": (sets.first(previous, 0), sets.first(current, 0)),
            "nothing seen before": (sets.only_valid(previous, 0), current),
        }
        for name, (before, now) in scenes.items():
            features = now.features.detach().clone().requires_grad_()
            try:
                states = self.roll(dynamics, before, replace(now, features=features))
            except Exception as error:
                raise AssertionError(f"{name}: {type(error).__name__}: {error}") from error
            assert states[-1].positions.shape == now.positions.shape, name
            assert_finite(states, f"{name}: states")
            dynamics.zero_grad()
            total = summed([_valid(state) for state in states])
            if total.requires_grad:
                total.backward()
            gradients = {key: parameter.grad for key, parameter in dynamics.named_parameters()}
            assert_finite([gradients, features.grad], f"{name}: gradient ")

    def test_all_that_was_learned_is_in_the_state_dict(self) -> None:
        trained, fresh = self.built(), self.build().to(self.device, torch.float64).eval()
        fresh.load_state_dict(trained.state_dict())
        assert_same(self.roll(fresh, *self.particles()), self.roll(trained, *self.particles()))


def _valid(particles: Particles) -> State:
    """Return positions and features with zeros in padding, whose content means nothing."""
    mask = particles.mask[..., None]
    return torch.where(mask, particles.positions, 0.0), torch.where(mask, particles.features, 0.0)


def _assert_plain(memory: Any) -> None:
    if memory is None:
        return
    assert is_dataclass(memory), f"memory must be None or a dataclass of tensors, got {type(memory).__name__}"
    for item in fields(memory):
        value = getattr(memory, item.name)
        if is_dataclass(value):  # a dynamics that wraps another one keeps the memory of that one, too
            _assert_plain(value)
            continue
        is_plain = value is None or isinstance(value, Tensor | bool | int | float | str | Particles)
        assert is_plain, f"memory.{item.name} is a {type(value).__name__}; a memory holds tensors and plain numbers"
