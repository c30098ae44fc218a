"""Evaluations of VPD against what needs no learning."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import page_tables
from docs.results.studies import vpd_motion

CLIPS, STEPS = 6, 32


def write_evaluation(folder: Path, gain: float) -> None:
    """Six clips of three trajectories; the model's error is that of standing still, less ``gain`` (metres)."""
    folder.mkdir()
    still = np.random.default_rng(0).uniform(0.5, 1.0, (CLIPS, 1, STEPS))
    np.savez(
        folder / "arrays.npz",
        **{
            "trajectory": np.repeat(np.arange(3), 2),
            "motion/centroid_error": still - gain,
            "motion/centroid_error_copy": still,
            "motion/centroid_error_constant": still + 0.1,
            "motion/centroid_error_velocity": 0 * still,
            "motion/size_ratio": np.ones((CLIPS, 1, STEPS)),
        },
    )
    value = {"mean": 0.5, "input_views": 0.4}
    pictures = {name: value for name in ("psnr", "psnr_moving", "ssim")}
    metrics = {
        "seed": 0, "checkpoint_sha256": "a", "data_sha256": "b", "step": 7, "training": {},
        "protocol": {"num_bootstrap": 50}, "chamfer": {"mean": 0.02}, "long_rollout": None, **pictures,
        "references": {"copy_last": pictures, "train_mean": pictures},
    }  # fmt: skip
    (folder / "metrics.json").write_text(json.dumps(metrics))


def test_a_difference_that_is_the_same_everywhere_has_an_interval_without_width(tmp_path: Path) -> None:
    write_evaluation(tmp_path / "one", 0.05)
    out = tmp_path / "out.json"

    assert vpd_motion.main([str(out), f"seed 0={tmp_path / 'one'}"]) == 0

    row = json.loads(out.read_text())["seed 0"]
    for name, centimetres in {"nothing_moves": -5.0, "best_constant": -15.0}.items():
        for step in vpd_motion.STEPS:
            found = row["difference"][name][str(step)]
            assert found["count"] == CLIPS
            assert [found["mean"], *found["ci95"]] == pytest.approx(3 * [centimetres])
    assert row["difference"]["constant_velocity"]["1"]["mean"] > 0
    table = page_tables.vpd_motion({"seed 0": row}, out)
    assert "| seed 0, less the best constant | -15.0 [-15.0, -15.0] |" in table
    assert "| seed 0, less nothing moves | -5.0 [-5.0, -5.0] |" in table
    assert "| seed 0 | 0.50 | 0.50 | 0.500 | 2.0 | 1.00 | 7 |" in table
    row["size_ratio"]["32"]["mean"] = None
    assert "| seed 0 | 0.50 | 0.50 | 0.500 | 2.0 | - | 7 |" in page_tables.vpd_motion({"seed 0": row}, out)


def test_what_is_no_evaluation_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        vpd_motion.main([str(tmp_path / "out.json"), f"seed 0={tmp_path}"])
