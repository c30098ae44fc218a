"""What training relies on in a loss."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.testing import particle_sets as sets
from vpd_lightning.testing.contract import (
    Contract,
    assert_finite,
    assert_same,
    describe_case,
    global_randomness_untouched,
    may_depart,
    tensors_of,
    unchanged,
)
from vpd_lightning.testing.scenes import ball_particles, video_batch
from vpd_lightning.types import RenderedRays, SimulatorOutput, VideoBatch


class LossContract(Contract):
    """Subclass as ``class TestMine(LossContract)`` and return the loss from ``build``.

    The checks give it a batch (``video_batch``) and what a simulator could have made of it, coarse colours included.
    Override ``output`` where the loss needs more, such as an entry of ``auxiliary``.
    """

    def build(self) -> AbstractLoss:
        """Return a new loss."""
        return super().build()

    def batch(self, batch_size: int = 3) -> VideoBatch:
        """Return the batch of the checks."""
        return video_batch(batch_size).to(self.device)

    def output(self, batch: VideoBatch) -> SimulatorOutput:
        """Return what a simulator could have made of the batch."""
        generator = torch.Generator().manual_seed(6)
        shape = batch.rgbs.shape
        size, num_steps = shape[0], shape[1]
        noise = [torch.rand(shape, generator=generator, dtype=torch.float64).to(batch.rgbs) for _ in range(2)]
        depths, opacities = 1 + noise[0][..., 0], noise[1][..., 0]
        particles = ball_particles(size)[1].to(batch.rgbs.device, batch.rgbs.dtype)
        states = [replace(particles, positions=particles.positions + 0.01 * step) for step in range(num_steps)]
        return SimulatorOutput(RenderedRays(noise[0], depths, opacities, noise[1]), states)

    def test_has_a_name_and_a_weight(self) -> None:
        loss = self.build()
        assert isinstance(loss.name, str) and loss.name.isidentifier(), f"name is {loss.name!r}; it is a column of logs"
        assert isinstance(loss.weight, int | float) and loss.weight >= 0

    def test_gives_one_finite_number_in_the_given_precision(self) -> None:
        for dtype in (torch.float32, torch.float64):
            batch = self.batch().to(dtype)
            value = self.built(dtype)(self.output(batch), batch)
            assert value.shape == () and value.dtype == dtype
            assert_finite(value, "loss")

    def test_a_finite_gradient_reaches_what_was_predicted(self) -> None:
        batch = self.batch()
        output = _with_gradients(self.output(batch))
        self.built().train()(output, batch).backward()
        gradients = {name: tensor.grad for name, tensor in tensors_of(output) if tensor.grad is not None}
        assert any(gradient.any() for gradient in gradients.values()), "the loss teaches nothing: no gradient"
        assert_finite(gradients, "gradient of ")

    @may_depart
    def test_a_batch_is_the_mean_of_its_members(self) -> None:
        """What makes a training on several devices equal to one with the whole batch on a single device."""
        loss, batch = self.built(), self.batch()
        output = self.output(batch)
        alone = [loss(_member_output(output, index), _member_batch(batch, index)) for index in range(3)]
        assert_same(loss(output, batch), torch.stack(alone).mean(), self.tolerance)

    def test_padding_changes_nothing(self) -> None:
        loss, batch = self.built(), self.batch()
        output = self.output(batch)
        plain = loss(output, batch)
        for where, padded in sets.PADDINGS.items():
            with describe_case(f"with padding {where}"):
                wide = replace(output, states=[padded(state) for state in output.states])
                assert_same(loss(wide, batch), plain, self.tolerance)

    def test_repeats_and_leaves_inputs_and_global_randomness_alone(self) -> None:
        loss, batch = self.built().train(), self.batch()
        output = self.output(batch)
        with unchanged(output, batch), global_randomness_untouched():
            first = loss(output, batch)
        assert_same(loss(output, batch), first)


def _with_gradients(output: SimulatorOutput) -> SimulatorOutput:
    for _, tensor in tensors_of(output):
        if tensor.is_floating_point() and tensor.is_leaf:
            tensor.requires_grad_()
    return output


def _slice(value: Tensor | None, index: int) -> Any:
    return None if value is None else value[index : index + 1]


def _member_output(output: SimulatorOutput, index: int) -> SimulatorOutput:
    rendered = output.rendered
    return SimulatorOutput(
        None
        if rendered is None
        else RenderedRays(
            _slice(rendered.rgbs, index),
            _slice(rendered.depths, index),
            _slice(rendered.opacities, index),
            _slice(rendered.coarse_rgbs, index),
        ),
        [sets.member(state, index) for state in output.states],
        {name: _slice(value, index) for name, value in output.auxiliary.items()},
    )


def _member_batch(batch: VideoBatch, index: int) -> VideoBatch:
    some = slice(index, index + 1)
    return VideoBatch(
        context=batch.context[some],
        rays=replace(batch.rays, origins=batch.rays.origins[some], directions=batch.rays.directions[some]),
        rgbs=batch.rgbs[some],
        keys=replace(batch.keys, sample_index=[batch.keys.sample_index[index]]),
        clips=[batch.clips[index]],
        future=None if batch.future is None else batch.future[some],
    )
