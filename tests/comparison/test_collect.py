"""Which runs a report takes, and what it says about the others."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.comparison.made_runs import MakeRun
from vpd_lightning.comparison.collect import collect
from vpd_lightning.comparison.comparison_table import comparison_tables
from vpd_lightning.errors import ConfigError, DataError


def reasons(folder: Path) -> dict[str, str]:
    return {path.name: why for path, why in collect([folder], "test").left_out}


def change_metrics(run: Path, **values: object) -> None:
    path = run / "evaluation" / "metrics.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def test_runs_are_found_at_any_depth_and_once(make_run: MakeRun, tmp_path: Path):
    make_run("a/b/first")
    second = make_run("second", system="global")
    (second / "pretraining" / "evaluation").mkdir(parents=True)
    (second / "pretraining" / "config.yaml").write_text("experiment: x\n")

    found = collect([tmp_path / "runs", tmp_path / "runs" / "second"], "test")

    assert sorted(run.system for run in found.runs) == ["global", "vpd"]
    assert found.left_out == []


def test_broken_and_old_runs_are_named_with_a_reason(make_run: MakeRun, tmp_path: Path):
    make_run("good")
    old = make_run("old", seed=1)
    content = yaml.safe_load((old / "config.yaml").read_text())
    (old / "config.yaml").write_text(yaml.safe_dump({k: v for k, v in content.items() if k != "system"}))
    change_metrics(old, system=None)
    metrics = json.loads((old / "evaluation" / "metrics.json").read_text())
    del metrics["system"]
    (old / "evaluation" / "metrics.json").write_text(json.dumps(metrics))
    not_evaluated = make_run("not_evaluated")
    os.rename(not_evaluated / "evaluation", not_evaluated / "elsewhere")
    (not_evaluated / "checkpoints").mkdir()
    (not_evaluated / "checkpoints" / "last.ckpt").touch()
    (make_run("no_json") / "evaluation" / "metrics.json").write_text("{")
    (make_run("no_yaml") / "config.yaml").write_text("a: [")
    (make_run("no_arrays") / "evaluation" / "arrays.npz").write_bytes(b"PK nothing")
    change_metrics(make_run("newer_format"), format_version=99)
    change_metrics(make_run("strange"), protocol="paper")
    (make_run("no_time") / "training_time.json").write_text("{}")
    (tmp_path / "runs" / "bare").mkdir()
    (tmp_path / "runs" / "bare" / "metrics.json").write_text("{}")

    found = collect([tmp_path / "runs"], "test")

    assert [run.folder.name for run in found.runs] == ["good"]
    why = {path.relative_to(tmp_path / "runs").parts[0]: reason for path, reason in found.left_out}
    assert "does not say its system" in why["old"]
    assert why["not_evaluated"].startswith("not evaluated: vpd-eval ckpt=")
    assert "not JSON" in why["no_json"] and "not YAML" in why["no_yaml"]
    assert "arrays.npz cannot be read" in why["no_arrays"]
    assert "format 99" in why["newer_format"]
    assert "protocol" in why["strange"] and "not those of vpd-eval" in why["no_time"]
    assert "no config.yaml" in why["bare"]


def test_arrays_that_do_not_give_the_printed_mean_are_refused(make_run: MakeRun, tmp_path: Path):
    make_run("good")
    psnr = json.loads((make_run("wrong", seed=1) / "evaluation" / "metrics.json").read_text())["psnr"]
    change_metrics(tmp_path / "runs" / "wrong", psnr={**psnr, "mean": psnr["mean"] + 1e-3})

    assert "in arrays.npz and" in reasons(tmp_path / "runs")["evaluation"]


def test_the_newest_evaluation_of_the_split_counts(make_run: MakeRun, tmp_path: Path):
    run = make_run("run", psnr=30.0)
    for name, split, age in (("evaluation_2", "test", 10), ("evaluation_validation", "validation", 0)):
        other = make_run(f"other_{name}", psnr=33.0, protocol={"split": split}, evaluation=name)
        os.rename(other / name, run / name)
        text = (run / name / "metrics.json").read_text()
        (run / name / "metrics.json").write_text(text.replace(str(other / "no_data"), str(run / "no_data")))
        (other / "config.yaml").unlink()
        (other / "training_time.json").unlink()
        other.rmdir()
        stamp = 1_900_000_000 - age
        os.utime(run / name / "metrics.json", (stamp, stamp))

    found = collect([tmp_path / "runs"], "test")

    assert [run.evaluation.name for run in found.runs] == ["evaluation_2"]
    why = {path.name: reason for path, reason in found.left_out}
    assert "older evaluation" in why["evaluation"] and "validation split" in why["evaluation_validation"]
    assert [run.evaluation.name for run in collect([tmp_path / "runs"], "validation").runs] == ["evaluation_validation"]


def test_an_evaluation_without_depth_is_a_row_of_its_own(make_run: MakeRun, tmp_path: Path):
    run, other = make_run("run", psnr=30.0), make_run("other", psnr=25.0, evaluation="evaluation_2")
    os.rename(other / "evaluation_2", run / "evaluation_2")
    (other / "config.yaml").unlink()
    path = run / "evaluation_2" / "metrics.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "hide_depth": True}))

    found = collect([tmp_path / "runs"], "test")

    [board] = comparison_tables(found.runs)
    assert found.left_out == []
    assert sorted(row.name for row in board.rows) == ["vpd", "vpd (hide_depth=true)"]
    assert [row.name for row in board.main_rows] == ["vpd"]


def test_the_same_training_counts_once(make_run: MakeRun, tmp_path: Path):
    make_run("first")
    newer = make_run("again")
    os.utime(newer / "evaluation" / "metrics.json", (2_000_000_000, 2_000_000_000))
    make_run("another_seed", seed=1)

    found = collect([tmp_path / "runs"], "test")

    assert sorted(run.folder.name for run in found.runs) == ["again", "another_seed"]
    assert "same system, settings and seed" in found.left_out[0][1]


def test_other_clips_do_not_enter_a_table(make_run: MakeRun, tmp_path: Path):
    make_run("a")
    make_run("b", seed=1)
    make_run("c", seed=2, first_clip=50)

    assert "other clips" in reasons(tmp_path / "runs")["c"]


def test_a_run_without_arrays_is_kept(make_run: MakeRun, tmp_path: Path):
    (make_run("a") / "evaluation" / "arrays.npz").unlink()

    run = collect([tmp_path / "runs"], "test").runs[0]

    assert run.samples == {} and run.metrics["psnr"]["mean"] > 0


def test_the_sums_give_the_printed_means(make_run: MakeRun, tmp_path: Path):
    make_run("a")
    run = collect([tmp_path / "runs"], "test").runs[0]

    for (source, name), (total, count) in run.samples.items():
        place = run.metrics if source == "model" else run.metrics["references"][source]
        summary = (place.get(name) or (place.get("motion") or {}).get(name))["mean"]
        assert np.sum(total) / np.sum(count) == pytest.approx(summary, rel=1e-12)
    assert {name for source, name in run.samples if source == "model"} >= {"psnr", "ssim", "centroid_error", "chamfer"}


def test_nothing_found_says_what_to_do(tmp_path: Path, make_run: MakeRun):
    with pytest.raises(ConfigError, match="no folder"):
        collect([tmp_path / "nowhere"], "test")
    with pytest.raises(DataError, match="vpd-eval ckpt="):
        collect([tmp_path], "test")
    make_run("a", protocol={"split": "validation"})
    with pytest.raises(DataError, match="validation split"):
        collect([tmp_path / "runs"], "test")
