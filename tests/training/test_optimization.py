"""Learning rates over a training."""

import pytest
import torch

from tests.training.tiny_training import tiny_simulator
from vpd_lightning.config import compose
from vpd_lightning.errors import ConfigError
from vpd_lightning.training.optimization import StepDecayAdam, WarmupCosineAdam

ADAM = {"betas": [0.9, 0.999], "eps": 1e-8}


def test_the_papers_rate_is_divided_by_three_at_each_milestone() -> None:
    settings = StepDecayAdam(lr=3e-4, milestones=[100_000, 300_000], gamma=1 / 3, **ADAM)
    rates = [3e-4 * settings.lr_factor(step, 400_000) for step in (0, 99_999, 100_000, 299_999, 300_000, 399_999)]
    assert rates == pytest.approx([3e-4, 3e-4, 1e-4, 1e-4, 1e-4 / 3, 1e-4 / 3])


def test_the_schedule_moves_with_every_update() -> None:
    optimizer, schedule = StepDecayAdam(lr=1.0, milestones=[2], gamma=0.5, **ADAM).build(tiny_simulator(), max_steps=4)
    rates = []
    for _ in range(4):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert rates == [1.0, 1.0, 0.5, 0.5]


def test_warm_up_rises_linearly_and_the_cosine_falls_to_its_final_share() -> None:
    settings = WarmupCosineAdam(lr=1.0, stage_multipliers={}, warmup_steps=4, final_share=0.1, **ADAM)
    shares = [settings.lr_factor(step, 104) for step in range(105)]
    assert shares[:5] == pytest.approx([0.25, 0.5, 0.75, 1.0, 1.0])
    assert shares[54] == pytest.approx(0.55)  # half-way between 1 and 0.1
    assert shares[104] == pytest.approx(0.1)
    assert all(a >= b for a, b in zip(shares[4:], shares[5:], strict=False))


def test_each_stage_has_its_own_rate_and_every_weight_is_in_one_group() -> None:
    simulator = tiny_simulator()
    settings = WarmupCosineAdam(
        lr=1.0, stage_multipliers={"encoder": 0.5, "renderer": 2.0}, warmup_steps=0, final_share=1.0, **ADAM
    )
    optimizer, _ = settings.build(simulator, max_steps=10)
    assert {group["name"]: group["lr"] for group in optimizer.param_groups} == {
        "encoder": 0.5, "dynamics": 1.0, "renderer": 2.0
    }  # fmt: skip
    grouped = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    assert {id(p) for p in grouped} == {id(p) for p in simulator.parameters()} and len(grouped) == len(set(grouped))


def test_a_multiplier_of_no_stage_is_refused() -> None:
    settings = WarmupCosineAdam(lr=1.0, stage_multipliers={"decoder": 2.0}, warmup_steps=0, final_share=1.0, **ADAM)
    with pytest.raises(ValueError, match="'decoder', but the stages are encoder, dynamics, renderer"):
        settings.build(tiny_simulator(), max_steps=1)
    neutral = WarmupCosineAdam(lr=1.0, stage_multipliers={"decoder": 1.0}, warmup_steps=0, final_share=1.0, **ADAM)
    assert neutral.build(tiny_simulator(), max_steps=1)


def test_a_stage_whose_multiplier_is_zero_is_frozen() -> None:
    simulator = tiny_simulator()
    multipliers = {"encoder": 0.0, "dynamics": 1.0, "renderer": 0.0}
    settings = WarmupCosineAdam(lr=1.0, stage_multipliers=multipliers, warmup_steps=0, final_share=1.0, **ADAM)
    settings.freeze(simulator)
    optimizer, _ = settings.build(simulator, max_steps=1)
    assert [group["name"] for group in optimizer.param_groups] == ["dynamics"]
    assert {name.split(".")[0] for name, each in simulator.named_parameters() if each.requires_grad} == {"dynamics"}


def test_a_training_in_which_nothing_learns_is_refused() -> None:
    multipliers = {"encoder": 0.0, "dynamics": 0.0, "renderer": 0.0}
    settings = WarmupCosineAdam(lr=1.0, stage_multipliers=multipliers, warmup_steps=0, final_share=1.0, **ADAM)
    with pytest.raises(ConfigError, match="Nothing learns: optimizer.stage_multipliers freezes"):
        settings.freeze(tiny_simulator())


def test_every_stage_has_a_multiplier_to_set_on_the_command_line() -> None:
    config = compose("train", ["experiment=demo", "optimizer.stage_multipliers.dynamics=0.1", "run.folder=x"])
    assert config["optimizer"]["stage_multipliers"] == {"encoder": 1.0, "dynamics": 0.1, "renderer": 1.0}


@pytest.mark.parametrize(
    "change", [{"lr": 0.0}, {"eps": -1.0}, {"betas": [0.9]}, {"betas": [0.9, 1.0]}, {"gamma": 0.0}, {"milestones": [0]}]
)
def test_settings_out_of_range_are_refused(change: dict[str, object]) -> None:
    settings = {"lr": 1e-3, "betas": [0.9, 0.999], "eps": 1e-8, "milestones": [5], "gamma": 0.5}
    with pytest.raises(ValueError, match="must"):
        StepDecayAdam(**{**settings, **change})  # type: ignore[arg-type]


def test_a_frozen_weight_is_not_optimised() -> None:
    simulator = tiny_simulator()
    simulator.encoder.requires_grad_(False)
    optimizer, _ = StepDecayAdam(lr=1.0, milestones=[], gamma=0.5, **ADAM).build(simulator, max_steps=1)
    assert [group["name"] for group in optimizer.param_groups] == ["dynamics", "renderer"]
    assert isinstance(optimizer, torch.optim.Adam)
