"""Long rollouts: what each figure says, and over how many clips."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.evaluation.tossed_box import Oracle
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.evaluation.evaluate import evaluate
from vpd_lightning.evaluation.long_rollout import LongRollout, judge_long_rollout
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.evaluation.report import metrics_of
from vpd_lightning.evaluation.summary import summary_lines
from vpd_lightning.simulator import Scene
from vpd_lightning.types import Particles

NUM_STEPS, NUM_PARTICLES, NUM_BODY = 4, 301, 100


def judge(positions: Tensor, **changes: Tensor) -> LongRollout:
    """Judge a rollout whose first 100 particles are the body and which the recording shows for two steps."""
    bodies = (torch.arange(NUM_PARTICLES) < NUM_BODY)[None]
    known, missing = torch.ones(1, NUM_STEPS), torch.tensor([[1.0, 1.0, torch.nan, torch.nan]])
    motion = {name: known for name in ("size_ratio", "lowest_point")}
    motion |= {name: missing for name in ("centroid_error", "centroid_error_copy")}
    return judge_long_rollout("clip", 0, positions, bodies, {**motion, **changes})


def at_rest() -> Tensor:
    return torch.rand(1, NUM_PARTICLES, 3, dtype=torch.float64).repeat(NUM_STEPS + 1, 1, 1)


def test_one_floor_particle_that_moves_shows_in_the_maximum_and_not_in_the_median() -> None:
    positions = at_rest()
    positions[2:, -1, 0] += 0.05  # of 201 floor particles
    rollout = judge(positions)
    assert rollout.floor_drift_max == pytest.approx(0.05)
    assert rollout.floor_drift_median == rollout.floor_drift_p99 == 0


def test_floor_drift_is_the_largest_over_the_steps_and_the_body_is_not_floor() -> None:
    positions = at_rest()
    positions[2, -1, 0] += 0.05  # it comes back
    positions[:, :NUM_BODY] += torch.arange(NUM_STEPS + 1)[:, None, None]
    rollout = judge(positions)
    assert rollout.floor_drift_max == pytest.approx(0.05)
    assert rollout.final_speed == [pytest.approx(3**0.5)]


def test_an_error_that_is_not_a_number_at_the_last_true_step_is_not_replaced_by_an_earlier_one() -> None:
    lost = torch.tensor([[0.5, torch.nan, torch.nan, torch.nan]])
    rollout = judge(at_rest(), centroid_error=lost)
    assert torch.tensor(rollout.centroid_error).isnan().all()
    assert rollout.centroid_error_copy == [1.0]


class SometimesBroken(Oracle):
    """An oracle that predicts no numbers from the sixth step on for the first recording."""

    def rollout(self, scene: Scene, num_steps: int) -> list[Particles]:
        states = super().rollout(scene, num_steps)
        if int(scene.current.features[0, 0, 0]) > 0:
            return states
        return states[:5] + [replace(state, positions=state.positions * torch.nan) for state in states[5:]]


def test_clips_without_a_value_are_counted_and_said(
    manifest: Manifest, protocol: Protocol, test_paths: list[Path]
) -> None:
    metrics = metrics_of(evaluate(SometimesBroken(test_paths), manifest, protocol, [0]), protocol, {})
    long = metrics["long_rollout"]
    assert (long["num_clips"], long["num_finite"], long["finite"]) == (3, 2, False)
    for name in ("floor_drift", "size_ratio", "lowest_point", "final_speed", "centroid_error"):
        assert long[name]["count"] == 2, name
    assert long["floor_drift"]["max"] == 0
    lines = summary_lines(metrics)
    assert "20-step rollout of 3 clips: NOT FINITE in 1 of them" in lines
    for label in ("floor drift", "block size", "lowest point", "last speed"):
        [line] = [line for line in lines if line.startswith(f"  {label}")]
        assert line.endswith("(2 of 3 clips)") and len(line) <= 100


def test_nothing_is_said_of_counts_where_every_clip_has_its_values(
    manifest: Manifest, protocol: Protocol, test_paths: list[Path]
) -> None:
    metrics = metrics_of(evaluate(Oracle(test_paths), manifest, protocol, [0]), protocol, {})
    assert metrics["long_rollout"]["floor_drift"]["count"] == metrics["long_rollout"]["num_clips"] == 3
    text = "\n".join(summary_lines(metrics))
    assert "of 3 clips)" not in text
    assert text.index("worst particle") < text.index("median clip")
