"""The contracts themselves: each fault must be found by the check that is named beside it."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from tests.test_contracts import composed, small
from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.persistence import PersistenceDynamics
from vpd_lightning.encoder.unet import UNetEncoder
from vpd_lightning.losses.pixel import PixelLoss
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.testing import (
    FEATURE_DIM,
    DynamicsContract,
    EncoderContract,
    LossContract,
    RendererContract,
    particle_sets,
)


class Drifting(AbstractDynamics):
    """Keeps the contract: everything moves by the mean of the features, learned and a little random."""

    def __init__(self) -> None:
        super().__init__()
        self.step = torch.nn.Linear(FEATURE_DIM, 3)

    def forward(self, previous: Any, current: Any, memory: Any, keys: Any, rollout_step: int) -> Any:
        draws = [torch.rand(3, generator=generator) for generator in keys.generators(f"drift/{rollout_step}")]
        step = self.step(current.features) * (1 + torch.stack(draws)[:, None].to(current.positions))
        return replace(current, positions=current.positions + step), memory


class DrawsGlobally(Drifting):
    def forward(self, previous: Any, current: Any, *more: Any) -> Any:
        following, memory = super().forward(previous, current, *more)
        return replace(following, positions=following.positions + torch.rand_like(following.positions)), memory


class ChangesItsInput(Drifting):
    def forward(self, previous: Any, current: Any, *more: Any) -> Any:
        current.features[:, 0] *= 0.5
        return super().forward(previous, current, *more)


class SeesTheOrigin(Drifting):
    def forward(self, previous: Any, current: Any, *more: Any) -> Any:
        following, memory = super().forward(previous, current, *more)
        return replace(following, positions=0.9 * following.positions), memory


class SeesPadding(Drifting):
    def forward(self, previous: Any, current: Any, *more: Any) -> Any:
        following, memory = super().forward(previous, current, *more)
        mean = following.features.mean(dim=1, keepdim=True)
        return replace(following, features=following.features + mean), memory


class IgnoresTheMask(Drifting):
    """As a graph network that forgets the mask: a particle is pushed by all that lies near, padding included."""

    def forward(self, previous: Any, current: Any, *more: Any) -> Any:
        following, memory = super().forward(previous, current, *more)
        offsets = current.positions[:, :, None] - current.positions[:, None]
        push = (offsets * (-(offsets / 0.1).square().sum(dim=-1, keepdim=True)).exp()).sum(dim=2)
        return replace(following, positions=following.positions + 0.1 * push), memory


class SeesItsNeighborsInTheBatch(Drifting):
    def forward(self, previous: Any, current: Any, *more: Any) -> Any:
        following, memory = super().forward(previous, current, *more)
        return replace(following, features=following.features + following.features[:1, :1].detach()), memory


class SeesSlots(Drifting):
    def forward(self, previous: Any, current: Any, *more: Any) -> Any:
        following, memory = super().forward(previous, current, *more)
        return replace(following, features=following.features + following.mask.cumsum(dim=1)[..., None]), memory


class RemembersInSecret(Drifting):
    def initialize(self, previous: Any, current: Any, keys: Any) -> Any:
        return lambda: current


class NeverLearns(Drifting):
    def forward(self, previous: Any, current: Any, *more: Any) -> Any:
        return super().forward(previous, replace(current, features=current.features.detach()), *more)


class LosesColors(Drifting):
    def forward(self, previous: Any, current: Any, *more: Any) -> Any:
        following, memory = super().forward(previous, current, *more)
        return replace(following, colors=None), memory


class SumLoss(PixelLoss):
    def forward(self, output: Any, batch: Any) -> Any:
        return (output.rendered.rgbs - batch.rgbs).square().sum()


class UnevenRenderer(SplatRenderer):
    def forward(self, particles: Any, rays: Any, keys: Any) -> Any:
        rendered = super().forward(particles, rays, keys)
        return replace(rendered, depths=rendered.depths - rendered.depths.mean())


def contract_of(contract: type, make: Any, **attributes: Any) -> Any:
    return type("OneContract", (contract,), {"build": lambda self: make(), **attributes})()


def checks(contract: Any) -> list[str]:
    return [name for name in dir(contract) if name.startswith("test_")]


def test_faultless_dynamics_keeps_every_check() -> None:
    contract = contract_of(DynamicsContract, Drifting)
    for name in checks(contract):
        getattr(contract, name)()


@pytest.mark.parametrize(
    ("faulty", "check"),
    [
        (DrawsGlobally, "test_same_keys_give_the_same_prediction_and_global_randomness_is_untouched"),
        (ChangesItsInput, "test_inputs_and_memory_stay_as_they_are"),
        (SeesTheOrigin, "test_moving_the_world_moves_the_prediction"),
        (SeesPadding, "test_padding_changes_nothing"),
        (IgnoresTheMask, "test_padding_changes_nothing"),
        (SeesItsNeighborsInTheBatch, "test_a_batch_equals_its_members"),
        (SeesSlots, "test_order_of_particles_does_not_matter"),
        (RemembersInSecret, "test_memory_is_plain_and_can_be_rebuilt_in_the_middle_of_a_rollout"),
        (NeverLearns, "test_every_weight_and_the_features_get_a_finite_gradient"),
        (LosesColors, "test_carries_observations_along"),
    ],
)
def test_faulty_dynamics_is_found_out(faulty: type, check: str) -> None:
    with pytest.raises(AssertionError):
        getattr(contract_of(DynamicsContract, faulty), check)()


def test_loss_that_grows_with_the_batch_is_found_out() -> None:
    contract = contract_of(LossContract, lambda: SumLoss(weight=1.0, coarse_weight=1.0))

    with pytest.raises(AssertionError):
        contract.test_a_batch_is_the_mean_of_its_members()


def test_renderer_whose_rays_see_each_other_is_found_out() -> None:
    contract = contract_of(RendererContract, lambda: UnevenRenderer(**without_target("renderer", "splat")))

    with pytest.raises(AssertionError):
        contract.test_a_ray_does_not_see_other_rays()


def test_padding_far_away_hides_a_dynamics_that_ignores_the_mask() -> None:
    """Why padding also lies among the particles: this fault passes where it does not."""
    contract = contract_of(DynamicsContract, IgnoresTheMask)
    dynamics, (previous, current) = contract.built(), contract.particles()
    plain = contract.roll(dynamics, previous, current)[-1].positions
    far, inside = (
        particle_sets.without_padding(contract.roll(dynamics, padded(previous), padded(current))[-1]).positions
        for padded in (particle_sets.padded_far, particle_sets.padded_inside)
    )
    assert torch.allclose(far, plain, rtol=0, atol=1e-6) and not torch.allclose(inside, plain, rtol=0, atol=1e-4)


class IgnoringLoss(PixelLoss):
    def forward(self, output: Any, batch: Any) -> Any:
        return super().forward(output, batch) + sum(state.positions.square().mean() for state in output.states)


def test_loss_that_ignores_the_mask_is_found_out() -> None:
    contract = contract_of(LossContract, lambda: IgnoringLoss(weight=1.0, coarse_weight=1.0))

    with pytest.raises(AssertionError, match="with padding"):
        contract.test_padding_changes_nothing()


class MasklessRenderer(SplatRenderer):
    def forward(self, particles: Any, rays: Any, keys: Any) -> Any:
        return super().forward(replace(particles, mask=torch.ones_like(particles.mask)), rays, keys)


def test_renderer_that_ignores_the_mask_is_found_out() -> None:
    contract = contract_of(RendererContract, lambda: MasklessRenderer(**without_target("renderer", "splat")))

    with pytest.raises(AssertionError, match="with padding among the particles"):
        contract.test_padding_changes_nothing()


class UnmeasuredEncoder(UNetEncoder):
    def forward(self, frames: Any, keys: Any, purpose: Any) -> Any:
        depth = torch.where(frames.depth > 0, frames.depth, 1.0)  # a pixel without depth lies a metre away
        return super().forward(replace(frames, depth=depth), keys, purpose)


def test_encoder_that_ignores_missing_depth_is_found_out() -> None:
    def make() -> Any:
        section = without_target("encoder", "unet")
        return UnmeasuredEncoder(**section)

    with pytest.raises(AssertionError, match="from every measured point"):
        contract_of(EncoderContract, make).test_particles_lie_on_what_was_measured()


def without_target(group: str, option: str) -> dict[str, Any]:
    return {key: value for key, value in small(composed(group, option)).items() if key != "_target_"}


def test_departure_that_is_none_must_not_be_declared() -> None:
    departures = {"test_order_of_particles_does_not_matter": "nobody looked"}
    contract = contract_of(DynamicsContract, PersistenceDynamics, departures=departures)

    with pytest.raises(AssertionError, match="the check passes"):
        contract.test_order_of_particles_does_not_matter()


@pytest.mark.parametrize("name", ["test_padding_changes_nothing", "test_misspelt"])
def test_only_checks_that_allow_it_can_be_departed_from(name: str) -> None:
    contract = contract_of(DynamicsContract, PersistenceDynamics, departures={name: "too hard"})

    with pytest.raises(AssertionError, match="possible are"):
        contract.test_departures_are_declared_by_name()


def test_contract_without_build_says_what_to_do() -> None:
    with pytest.raises(NotImplementedError, match="must define build"):
        EncoderContract().test_inputs_stay_as_they_are()
