"""SlotFormer's learning rate over a training, against its formula written out."""

import math
from typing import Any

import pytest

from tests.training.tiny_training import tiny_simulator
from vpd_lightning.config import compose
from vpd_lightning.training.warmup_share import WarmupShareCosineAdam

SETTINGS: dict[str, Any] = {"lr": 2e-4, "betas": [0.9, 0.999], "eps": 1e-8, "stage_multipliers": {}}


def schedule(warmup_share: float = 0.05, end_share: float = 0.01) -> WarmupShareCosineAdam:
    return WarmupShareCosineAdam(**SETTINGS, warmup_share=warmup_share, end_share=end_share)


@pytest.mark.parametrize(
    ("step", "share"),
    [
        (0, 0.01),
        (25, 0.01 + 0.99 / 2),  # half-way through the warm-up of 50 steps
        (50, 1.0),
        (525, 0.01 + 0.99 / 2),  # half-way through the cosine of 950 steps
        (50 + 950 // 3, 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * (950 // 3) / 950))),
        (1000, 0.01),
        (1500, 0.01),  # a time budget may allow more updates than were expected
    ],
)
def test_rises_from_and_falls_to_a_hundredth(step: int, share: float) -> None:
    assert schedule().lr_factor(step, 1000) == pytest.approx(share, rel=1e-12)


def test_warm_up_is_a_share_of_the_training_whatever_its_length() -> None:
    for max_steps in (1000, 4000, 83_200):
        shares = [schedule().lr_factor(round(part * max_steps), max_steps) for part in (0.025, 0.05, 0.5, 1.0)]
        assert shares == pytest.approx([0.505, 1.0, shares[2], 0.01])
        assert shares[2] == pytest.approx(schedule().lr_factor(500, 1000))


def test_rises_then_falls_without_a_step() -> None:
    shares = [schedule(0.1).lr_factor(step, 200) for step in range(201)]
    assert shares.index(max(shares)) == 20
    assert all(a < b for a, b in zip(shares[:20], shares[1:21], strict=True))
    assert all(a > b for a, b in zip(shares[20:-1], shares[21:], strict=True))
    assert max(abs(a - b) for a, b in zip(shares, shares[1:], strict=False)) < 0.99 / 20 + 1e-9


def test_no_warm_up_starts_at_the_full_rate() -> None:
    assert schedule(warmup_share=0.0).lr_factor(0, 10) == 1.0


def test_a_training_of_one_step_has_a_rate() -> None:
    assert 0.0 < schedule().lr_factor(0, 1) <= 1.0


def test_every_update_takes_its_rate() -> None:
    optimizer, scheduler = schedule(0.5).build(tiny_simulator(), 4)
    rates = []
    for _ in range(4):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    assert rates == pytest.approx([2e-6, 2e-4 * 0.505, 2e-4, 2e-4 * 0.505])


@pytest.mark.parametrize(
    ("option", "lr", "warmup_share"), [("adam_savi", 1e-4, 0.025), ("adam_slotformer", 2e-4, 0.05)]
)
def test_options_hold_the_papers_rates_and_the_released_schedule(option: str, lr: float, warmup_share: float) -> None:
    section = compose("train", [f"optimizer={option}", "data.folder=any", "run.folder=any"])["optimizer"]
    assert (section["lr"], section["warmup_share"], section["end_share"]) == (lr, warmup_share, 0.01)


@pytest.mark.parametrize("change", [{"warmup_share": 1.0}, {"warmup_share": -0.1}, {"end_share": 1.5}])
def test_shares_out_of_range_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="warmup_share must be in"):
        schedule(**change)
