"""The study of noisy depth reads what an evaluation writes, and makes nothing twice."""

import json
from pathlib import Path

import pytest

from docs.results.studies import noisy_depth


def summary(values: list[float | None]) -> dict[str, object]:
    return {"per_step": values, "mean": 1.0}


def write_metrics(path: Path) -> None:
    motion = {name: summary([0.01] * 7 + [None]) for name in ("centroid_error", "centroid_error_copy")}
    motion |= {name: summary([0.02] * 8) for name in ("centroid_error_constant", "centroid_error_velocity")}
    picture = {name: summary([20.0] * 8) for name in ("psnr", "psnr_moving", "ssim")}
    metrics = {
        "step": 7, "training": {"cpu_minutes": 5.0}, "protocol": {"num_clips": 4}, "motion": motion, **picture,
        "references": {"copy_last": {"psnr_moving": {"mean": 18.0}}},
    }  # fmt: skip
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(metrics))


def test_evaluations_that_are_there_are_read_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(noisy_depth, "_call", lambda *words: pytest.fail("everything is there"))
    for condition in ("clean", "active_stereo_0.5"):
        write_metrics(
            tmp_path / "runs" / "inertial_10_minutes" / f"movi_a_{condition}_seed1" / "evaluation" / "metrics.json"
        )
    out = tmp_path / "found.json"
    words = [str(out), str(tmp_path), "--scenes", "movi_a", "--seeds", "1", "--conditions", "clean,active_stereo_0.5"]
    assert noisy_depth.main(words) == 0
    cells = json.loads(out.read_text())["cells"]
    assert set(cells) == {"movi_a/clean/seed1", "movi_a/active_stereo_0.5/seed1"}
    cell = cells["movi_a/clean/seed1"]
    assert cell["centroid_error"] == {"1": 1.0, "4": 1.0, "8": None}
    assert cell["psnr_moving_references"] == {"copy_last": 18.0}
    before = out.read_bytes()
    assert noisy_depth.main(words) == 0
    assert out.read_bytes() == before


def test_what_is_missing_is_generated_trained_and_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[list[str]] = []

    def call(command: str, *words: str) -> None:
        called.append([command, *words])
        if command == "eval":
            write_metrics(
                tmp_path / "runs" / "vpd_staged_20_minutes" / "movi_a_poses_5mm_seed0" / "evaluation" / "metrics.json"
            )

    monkeypatch.setattr(noisy_depth, "_call", call)
    noisy_depth.measured("vpd_staged", 20, "movi_a", "poses_5mm", 0, tmp_path)
    assert [words[0] for words in called] == ["data", "train", "eval"]
    assert "sensor.pose_offset=0.005" in called[0]
    assert f"data.folder={tmp_path / 'movi_a_poses_5mm'}" in called[1] and "model=vpd_staged" in called[1]
    assert "callbacks.time_budget.minutes=20" in called[1]


STEPS = ("1", "4", "8", "16", "32")


def made_up(psnr: float, error: float, updates: int = 100) -> dict[str, object]:
    return {
        "updates": updates,
        "psnr_moving": psnr,
        "psnr_moving_references": {"copy_last": 8.0, "train_mean": 11.0},
        "centroid_error": {step: error * int(step) for step in STEPS},
        "nothing_moves": dict.fromkeys(STEPS, 9.0),
        "best_constant": dict.fromkeys(STEPS, 7.0),
        "constant_velocity": dict.fromkeys(STEPS, 4.0),
    }


def test_what_noise_costs_is_told_by_seeds_that_both_have() -> None:
    cells = {
        "movi_a/active_stereo_0.5/seed0": made_up(19.0, 1.5),
        "movi_a/active_stereo_0.5/seed1": made_up(10.0, 9.0, updates=300),
        "movi_a/clean/seed0": made_up(20.0, 1.0),
    }

    found = noisy_depth.means(cells)

    assert list(found) == ["movi_a/clean", "movi_a/active_stereo_0.5"]
    noisy = found["movi_a/active_stereo_0.5"]
    assert (noisy["seeds"], noisy["paired_seeds"], noisy["updates"]) == (2, 1, 200)
    assert noisy["psnr_moving"] == pytest.approx(14.5)
    assert noisy["psnr_moving_gap"] == pytest.approx(-1.0)
    assert noisy["centroid_error_4_gap"] == pytest.approx(2.0)
    assert noisy["centroid_error_4_ratio"] == pytest.approx(1.5)
    assert "psnr_moving_gap" not in found["movi_a/clean"]


def test_the_file_keeps_what_it_has_and_takes_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out.json"
    made: list[tuple[object, ...]] = []

    def measured(*words: object) -> dict[str, object]:
        made.append(words[:-1])
        return made_up(15.0, 1.0)

    monkeypatch.setattr(noisy_depth, "measured", measured)
    out.write_text(json.dumps({"note": "by hand", "cells": {"movi_a/clean/seed0": made_up(20.0, 1.0)}}))
    scene = [str(out), str(tmp_path), "--scenes", "movi_a", "--conditions", "clean,active_stereo_0.5", "--seeds", "0"]

    noisy_depth.main(scene)
    noisy_depth.main([*scene, "--minutes", "24", "--section", "24 minutes"])

    assert made == [
        ("inertial", 10, "movi_a", "active_stereo_0.5", 0),
        ("inertial", 24, "movi_a", "clean", 0),
        ("inertial", 24, "movi_a", "active_stereo_0.5", 0),
    ]
    whole = json.loads(out.read_text())
    assert whole["note"] == "by hand"
    assert whole["means"]["movi_a/active_stereo_0.5"]["psnr_moving_gap"] == pytest.approx(-5.0)
    assert whole["24 minutes"]["means"]["movi_a/active_stereo_0.5"]["psnr_moving_gap"] == pytest.approx(0.0)
