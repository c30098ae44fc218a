"""Checkpoints of trainings measured one after the other."""

import json
from pathlib import Path

import numpy as np
import pytest

from docs.results.studies import motion_curve
from tests.evaluation.untrained_model import write_untrained


def test_slope_and_correlation_are_those_of_each_body_beside_the_mean() -> None:
    true = np.random.default_rng(0).normal(size=(50, 3))
    found = motion_curve.first_step(np.stack([0.6 * true - [0.0, 0.0, 0.1], true], axis=1))
    assert found["correlation"] == pytest.approx(1.0) and found["slope"] == pytest.approx(0.6)
    expected = -100 * (0.6 * true[:, 2].mean() - 0.1)
    assert found["mean_fall_cm"] == pytest.approx(expected)


@pytest.mark.slow
@pytest.mark.exhaustive
def test_an_untrained_model_is_measured_once(tmp_path: Path) -> None:
    from data_gen.generate import generate

    sizes = {"splits.train": 2, "splits.validation": 1, "splits.test": 1}
    generate(scene="mujoco_block", preset="small", out=tmp_path / "data", seed=0, renderer="raycast", overrides=sizes)
    checkpoint = write_untrained(tmp_path / "run", tmp_path / "data")
    words = [str(tmp_path / "out.json"), str(tmp_path / "data"), f"a={checkpoint}", "--start-frames", "0,6"]

    assert motion_curve.main(words) == 0
    written = (tmp_path / "out.json").read_bytes()
    assert motion_curve.main(words) == 0

    assert (tmp_path / "out.json").read_bytes() == written
    (point,) = json.loads(written)["trainings"]["a"]["points"].values()
    assert point["clips"] == 2
    errors = point["centroid_error_cm"]
    assert errors["constant_velocity"]["1"] < errors["nothing_moves"]["1"]
    with pytest.raises(SystemExit):
        motion_curve.main([*words[:-1], "3"])
