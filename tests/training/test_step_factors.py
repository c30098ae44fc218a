"""Factors at shares of the training."""

import pytest

from vpd_lightning.training.step_factors import StepFactorsAdam

PAPER = {"lr": 1e-4, "betas": [0.9, 0.999], "eps": 1e-8, "stage_multipliers": {}}


def test_rate_falls_by_each_factor_at_its_share_of_any_training():
    adam = StepFactorsAdam(**PAPER, milestones=[0.25, 0.75], factors=[0.1, 1 / 3])

    for max_steps in (400_000, 100_000):
        quarter = max_steps // 4
        rates = [adam.lr_factor(step, max_steps) for step in (0, quarter - 1, quarter, 3 * quarter - 1, 3 * quarter)]
        assert rates == pytest.approx([1, 1, 0.1, 0.1, 0.1 / 3])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"milestones": [0.5], "factors": []}, "as long as each other"),
        ({"milestones": [100], "factors": [0.1]}, "shares of the training"),
        ({"milestones": [0.5], "factors": [0.0]}, "factors"),
    ],
)
def test_wrong_settings_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        StepFactorsAdam(**PAPER, **changes)
