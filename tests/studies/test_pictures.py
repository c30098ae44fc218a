"""Figures of predicted pictures by horizon, and the tables made of them."""

import json
from pathlib import Path
from typing import Any

from benchmarks import picture_tables
from docs.results.studies import pictures

STEPS = 8


def block(value: float, *, has_flip: bool = True) -> dict[str, Any]:
    names = ("psnr", "psnr_moving", "ssim", "moving_iou", *(["flip"] if has_flip else []))
    return {
        name: {
            "mean": value, "ci95": [value, value], "input_views": value, "other_views": None,
            "per_step": [value + step for step in range(1, STEPS + 1)],
        }
        for name in names
    }  # fmt: skip


def write_metrics(folder: Path, value: float, *, drawn: bool) -> None:
    folder.mkdir()
    curve = {"per_step": [0.01 * step for step in range(1, STEPS + 1)]}
    metrics = {
        "system": "inertial", "experiment": "demo", "seed": 0, "step": 9, "num_parameters": 7, "checkpoint_sha256": "a",
        "data_sha256": "b", "training": {}, "seconds": {}, "protocol": {"num_steps": STEPS}, **block(value),
        "references": {"copy_last": block(0.1), "train_mean": block(0.2, has_flip=False)},
        "drawn": {"nothing_moves": block(0.3), "true_motion": block(0.9)} if drawn else None,
        "reconstruction": {"psnr": 35.04, "ssim": 0.98},
        "motion": {"centroid_error": curve, "centroid_error_constant": curve},
    }  # fmt: skip
    (folder / "metrics.json").write_text(json.dumps(metrics))


def test_figures_by_horizon_stand_beside_those_of_all_that_needs_no_model(tmp_path: Path) -> None:
    write_metrics(tmp_path / "new", 0.5, drawn=True)
    write_metrics(tmp_path / "old", 0.4, drawn=False)
    out = tmp_path / "out.json"
    assert pictures.main([str(out), f"seed 0={tmp_path / 'new'}", f"older={tmp_path / 'old'}"]) == 0
    content = json.loads(out.read_text())

    new = content["seed 0"]
    assert list(new["pictures"]) == ["prediction", "copy_last", "train_mean", "nothing_moves", "true_motion"]
    assert new["pictures"]["prediction"]["ssim"]["per_step"] == {"1": 1.5, "4": 4.5, "8": 8.5}
    assert new["centroid_error"] == dict.fromkeys(("prediction", "best_constant"), {"1": 1.0, "4": 4.0, "8": 8.0})

    runs = picture_tables.picture_runs(content, out).splitlines()
    assert runs[2] == "| seed 0 | 0.50 | 0.50 | 0.500 | 0.500 | 0.500 | 35.0 | 0.980 | 1.0 | 4.0 | 8.0 |"
    assert [line.split(" |")[0] for line in runs[3:]] == [
        "| older",
        "| *last frame*",
        "| *mean image*",
        "| *best constant*",
    ]
    assert runs[-1] == "| *best constant* |  |  |  |  |  |  |  | 1.0 | 4.0 | 8.0 |"
    assert len({line.count("|") for line in runs}) == 1

    horizons = picture_tables.picture_horizons(content, out).splitlines()
    assert "| PSNR (dB) | prediction | 0.50 | 1.50 | 4.50 | 8.50 |" in horizons
    assert "|  | *true motion, same renderer* | 0.90 | 1.90 | 4.90 | 8.90 |" in horizons
    assert len({line.count("|") for line in horizons}) == 1


def test_a_score_that_one_of_them_lacks_is_left_empty(tmp_path: Path) -> None:
    write_metrics(tmp_path / "new", 0.5, drawn=False)
    out = tmp_path / "out.json"
    pictures.main([str(out), f"seed 0={tmp_path / 'new'}"])
    runs = picture_tables.picture_runs(json.loads(out.read_text()), out).splitlines()
    assert runs[4] == "| *mean image* | 0.20 | 0.20 | 0.200 |  | 0.200 |  |  |  |  |  |"


def test_data_sets_stand_below_each_other_with_their_own_references(tmp_path: Path) -> None:
    write_metrics(tmp_path / "new", 0.5, drawn=False)
    write_metrics(tmp_path / "old", 0.4, drawn=False)
    out = tmp_path / "out.json"
    names = [("block: new", "new"), ("block: old", "old"), ("ball: new", "new")]
    pictures.main([str(out), *(f"{name}={tmp_path / folder}" for name, folder in names)])
    content = json.loads(out.read_text())
    content["block: new"]["pictures"]["prediction"]["psnr"]["other_views"] = 0.25
    lines = picture_tables.picture_sets(content, out).splitlines()
    assert lines[2] == "| block | new | 0.50 / 0.25 | 0.50 | 0.500 | 0.500 | 0.500 | 4.0 | 8.0 | 9 |"
    assert [line.split(" | ")[:2] for line in lines[2:]] == [
        ["| block", "new"],
        ["| ", "old"],
        ["| ", "*last frame*"],
        ["| ", "*mean image*"],
        ["| ", "*best constant*"],
        ["| ball", "new"],
        ["| ", "*last frame*"],
        ["| ", "*mean image*"],
        ["| ", "*best constant*"],
    ]
    assert len({line.count("|") for line in lines}) == 1
