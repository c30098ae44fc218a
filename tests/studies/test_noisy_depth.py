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
        write_metrics(tmp_path / "runs" / "inertial" / f"movi_a_{condition}_seed1" / "evaluation" / "metrics.json")
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
            write_metrics(tmp_path / "runs" / "vpd_staged" / "movi_a_poses_5mm_seed0" / "evaluation" / "metrics.json")

    monkeypatch.setattr(noisy_depth, "_call", call)
    noisy_depth.measured("vpd_staged", "movi_a", "poses_5mm", 0, tmp_path)
    assert [words[0] for words in called] == ["data", "train", "eval"]
    assert "sensor.pose_offset=0.005" in called[0]
    assert f"data.folder={tmp_path / 'movi_a_poses_5mm'}" in called[1] and "model=vpd_staged" in called[1]
