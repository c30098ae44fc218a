"""Rows, boards, settings, warnings: what may stand beside what."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.comparison.made_runs import MakeRun
from vpd_lightning.comparison.collect import collect
from vpd_lightning.comparison.comparison_table import ComparisonTable, comparison_tables
from vpd_lightning.comparison.paired_differences import paired_differences, standing, told_apart
from vpd_lightning.comparison.settings import comparable_settings, naming_keys
from vpd_lightning.comparison.sweep import sweeps_of
from vpd_lightning.comparison.tables import systems_table, winners
from vpd_lightning.comparison.warnings import parted_experiments, table_warnings
from vpd_lightning.data.manifest import Manifest, write_manifest
from vpd_lightning.metrics.registry import metric


def boards(tmp_path: Path) -> list[ComparisonTable]:
    return comparison_tables(collect([tmp_path / "runs"], "test").runs)


def test_seeds_share_a_row_and_systems_keep_the_papers_order(make_run: MakeRun, tmp_path: Path):
    for seed, psnr in ((0, 30.0), (1, 31.0), (2, 35.0)):
        make_run(f"vpd{seed}", seed=seed, psnr=psnr)
    for system in ("persistence", "another", "slotformer", "global", "vpd_two_steps"):
        make_run(system, system=system)

    [board] = boards(tmp_path)

    assert [row.name for row in board.rows] == [
        "slotformer",
        "global",
        "vpd",
        "vpd_two_steps",
        "persistence",
        "another",
    ]
    row = board.rows[2]
    printed = [run.metrics["psnr"]["mean"] for run in row.runs]
    found = row.estimate("psnr")
    assert [run.seed for run in row.runs] == [0, 1, 2]
    assert found is not None and found.mean == pytest.approx(sum(printed) / 3, rel=1e-12)
    steps = [run.metrics["psnr"]["per_step"][1] for run in row.runs]
    assert row.per_step("psnr")[1] == pytest.approx(sum(steps) / 3)


def test_one_seed_has_the_printed_interval(make_run: MakeRun, tmp_path: Path):
    make_run("a")
    [board] = boards(tmp_path)

    for name in ("psnr", "psnr_moving", "ssim", "centroid_error", "chamfer"):
        summary = metric(name).summary(board.runs[0].metrics)
        found = board.rows[0].estimate(name)
        assert summary and found and found.interval == pytest.approx(summary["ci95"], rel=1e-9)


def test_other_data_and_other_protocols_get_their_own_table(make_run: MakeRun, tmp_path: Path):
    make_run("a")
    make_run("b", system="global", data_sha256="b" * 64)
    make_run("c", system="sequential", protocol={"num_steps": 3})
    make_run("d", system="inertial", protocol={"input_views": [0, 1]})

    found = boards(tmp_path)

    assert sorted([row.system for row in board.rows] for board in found) == [
        ["global"],
        ["sequential"],
        ["vpd", "inertial"],
    ]
    assert len({board.title for board in found}) == 3
    assert "must not be compared" in parted_experiments(found)[0]
    together = next(board for board in found if len(board.rows) == 2)
    assert any("do not look through the same cameras" in words for words in table_warnings(together))


def test_differing_budgets_and_seeds_are_told(make_run: MakeRun, tmp_path: Path):
    make_run("a", minutes=60.0)
    make_run("a1", minutes=60.0, seed=1)
    make_run("b", system="global", minutes=None)

    words = " ".join(table_warnings(boards(tmp_path)[0]))

    assert "budgets of the systems differ: global 500 steps; vpd 60 min cpu" in words
    assert "global 1, vpd 2" in words


def test_training_on_other_data_than_the_evaluation_is_told(make_run: MakeRun, tmp_path: Path):
    same, other = make_run("same"), make_run("other", system="global")
    for run, digest in ((same, "a" * 64), (other, "b" * 64)):
        path = run / "evaluation" / "metrics.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "training": {"data_sha256": digest}}))

    (words,) = [words for words in table_warnings(boards(tmp_path)[0]) if "trained on another data set" in words]

    assert str(other) in words and str(same) not in words


def test_same_budgets_warn_of_nothing(make_run: MakeRun, tmp_path: Path):
    make_run("a")
    make_run("b", system="global")

    assert table_warnings(boards(tmp_path)[0]) == []


def test_what_was_trained_on_is_marked_and_so_is_what_nobody_knows(make_run: MakeRun, tmp_path: Path):
    new, seen, old = make_run("new"), make_run("seen", system="global"), make_run("old", system="inertial")
    change_json(seen / "evaluation" / "metrics.json", seen_in_training={"trajectories": 2, "of": 3})
    change_json(old / "evaluation" / "metrics.json", seen_in_training=None)

    trained, unknown = (line for line in table_warnings(boards(tmp_path)[0]) if "trained on what" in line)
    assert f"{seen} (2 trajectories)" in trained and str(old) in unknown and "not known" in unknown
    assert str(new) not in trained + unknown


def test_all_trajectories_are_as_many_as_there_are(make_run: MakeRun, tmp_path: Path):
    make_run("gone", num_trajectories=None)
    data = make_run("there", num_trajectories=None, seed=1) / "no_data"
    files = [data / "train" / f"{number:06d}.h5" for number in range(3)]
    (data / "train").mkdir(parents=True)
    for path in files:
        path.write_bytes(b"x")
    names = [f"train/{path.name}" for path in files]
    sizes, sums = dict.fromkeys(names, 1), dict.fromkeys(names, "0" * 64)
    write_manifest(Manifest(data, "x", "x", "x", 0, {"train": files}, sums, sizes))

    counts = {run.folder.name: comparable_settings(run)["data.num_trajectories"] for run in boards(tmp_path)[0].runs}

    assert counts == {"gone": None, "there": 3}


def test_few_keys_name_the_settings():
    def config(trajectories: int, views: list[int], **more: Any) -> dict[str, Any]:
        copied = {"data.input_views": tuple(views), "scene.input_views": tuple(views)}
        return {"data.num_trajectories": trajectories, **copied, **more}

    assert naming_keys([config(16, [0]), config(32, [0])]) == ["data.num_trajectories"]
    assert naming_keys([config(16, [0]), config(16, [0, 1])]) == ["scene.input_views"]
    classes = [
        config(16, [0], **{"renderer._target_": "a.B", "renderer.x": 1}),
        config(16, [0], **{"renderer._target_": "a.C"}),
    ]
    assert naming_keys(classes) == ["renderer._target_"]
    assert naming_keys([{"a": 1, "b": True}, {"a": 1.0, "b": 1}]) == ["b"]


def test_seed_and_paths_are_no_settings(make_run: MakeRun, tmp_path: Path):
    for seed in (0, 1):
        settings = {"pretraining": {"ckpt": f"x{seed}"}, "num_threads": seed}
        make_run(f"a{seed}", seed=seed, settings=settings, minutes=None)

    assert [row.name for row in boards(tmp_path)[0].rows] == ["vpd"]


def test_the_setting_that_is_no_sweep_stands_for_the_system(make_run: MakeRun, tmp_path: Path):
    make_run("main", num_trajectories=64)
    for count in (16, 256):
        make_run(f"n{count}", num_trajectories=count, settings={"sweep_name": "data"})
    make_run("slots", system="slotformer", num_trajectories=64)

    [board] = boards(tmp_path)

    assert [row.name for row in board.main_rows] == ["slotformer", "vpd (data.num_trajectories=64)"]
    [sweep] = sweeps_of(board)
    assert sweep.is_logarithmic and sweep.title == "training trajectories"
    assert {name: [x for _, x in line] for name, line in sweep.lines.items()} == {
        "slotformer": [64.0],
        "vpd": [16.0, 64.0, 256.0],
    }


def test_where_all_are_sweeps_what_they_share_stands_for_the_system(make_run: MakeRun, tmp_path: Path):
    make_run("default", settings={"sweep_name": "views"})
    make_run("noise", settings={"sweep_name": "noise", "scene.location_noise": 1e-3})
    for count in (2, 3):
        views = list(range(count))
        changed = {"sweep_name": "views", "scene.input_views": views, "data.input_views": views}
        make_run(f"views{count}", settings=changed)

    [main] = boards(tmp_path)[0].main_rows

    assert main.runs[0].folder.name == "default"
    # A sweep over two systems tells more than one over settings.
    make_run("few", num_trajectories=16, settings={"sweep_name": "table2"})
    make_run("global", system="global", num_trajectories=16, settings={"sweep_name": "table2"})
    assert [row.runs[0].folder.name for row in boards(tmp_path)[0].main_rows] == ["global", "few"]


def test_two_swept_settings_give_two_sweeps(make_run: MakeRun, tmp_path: Path):
    make_run("main")
    make_run("few", num_trajectories=16, settings={"sweep_name": "x"})
    views = {"sweep_name": "y", "scene.input_views": [0, 1, 2], "data.input_views": [0, 1, 2]}
    make_run("views", settings=views)
    other = {"_target_": "a.b.PointFeatures", "num_layers": 9}
    make_run("renderer", settings={"sweep_name": "z", "renderer": other})

    sweeps = {sweep.key: sweep for sweep in sweeps_of(boards(tmp_path)[0])}

    assert set(sweeps) == {"data.num_trajectories", "scene.input_views", "renderer._target_"}
    assert [x for _, x in sweeps["scene.input_views"].lines["vpd"]] == [1.0, 3.0]
    assert [x for _, x in sweeps["data.num_trajectories"].lines["vpd"]] == [16.0, 256.0]
    assert sweeps["renderer._target_"].names == ["PointFeatures", "SplatRenderer"]


def test_the_best_stands_alone_only_where_no_interval_reaches_it(make_run: MakeRun, tmp_path: Path):
    make_run("a", psnr=30.0)
    make_run("b", system="global", psnr=29.0)  # trajectories differ by more than that
    make_run("c", system="sequential", psnr=10.0)
    [board] = boards(tmp_path)

    place = standing(board.main_rows, metric("psnr"))

    assert place is not None and place.best.system == "vpd"
    assert [row.system for row in place.within] == ["global"]
    # The same clips were hard for both, so that the pairs tell what the intervals cannot.
    assert [row.system for row in told_apart(place, 200)] == ["global"]
    sharp = standing(board.main_rows, metric("sharpness"))
    assert sharp is not None and sharp.best.system == "vpd"
    assert standing(board.main_rows, metric("penetration")) is None


def test_the_best_of_what_no_reference_is_behind_is_said_to_be_no_better(make_run: MakeRun, tmp_path: Path):
    make_run("a", psnr=21.0)  # between copying (20) and the mean image (22)
    make_run("b", system="global", psnr=12.0)
    [board] = boards(tmp_path)
    mean = board.reference("train_mean", "psnr")
    assert mean is not None

    [line] = [line for line in winners(board) if line.startswith("- PSNR (dB): vpd")]

    assert line.endswith(f"**No better than what predicts nothing: training mean ({mean.mean:.2f}).**")


def test_the_best_that_beats_the_references_is_said_without_them(make_run: MakeRun, tmp_path: Path):
    make_run("a", psnr=30.0)
    make_run("b", system="global", psnr=12.0)
    [board] = boards(tmp_path)

    [line] = [line for line in winners(board) if line.startswith("- PSNR (dB): vpd")]

    assert "predicts nothing" not in line


def test_paired_differences_are_those_of_the_means(make_run: MakeRun, tmp_path: Path):
    make_run("a", psnr=30.0)
    make_run("b", system="slotformer", psnr=28.0, has_particles=False)
    [board] = boards(tmp_path)

    found = {(first, second): values for first, second, values in paired_differences(board)}

    slots, vpd = board.rows[0].estimate("psnr"), board.rows[1].estimate("psnr")
    pair = found["slotformer", "vpd"]
    assert slots and vpd and pair["psnr"][0].mean == pytest.approx(slots.mean - vpd.mean)
    assert pair["psnr"][1] == 6 and "centroid_error" not in pair
    assert found["vpd", "copy_last"]["psnr"][0].mean == pytest.approx(10.0, abs=0.01)


def change_json(path: Path, **values: Any) -> None:
    path.write_text(json.dumps({**(json.loads(path.read_text()) if path.exists() else {}), **values}))


def test_nobody_is_best_where_budgets_differ(make_run: MakeRun, tmp_path: Path):
    make_run("a", psnr=40.0, minutes=60.0)
    make_run("b", system="global", minutes=30.0)
    [board] = boards(tmp_path)

    assert standing(board.main_rows, metric("psnr")) is None
    assert winners(board) == ["No system is called best, here and in the tables: their training budgets differ."]
    assert "**" not in "".join(systems_table(board))


def test_the_main_row_has_the_budget_that_most_systems_share(make_run: MakeRun, tmp_path: Path):
    for seed in range(3):
        make_run(f"long{seed}", seed=seed, minutes=600.0)
    make_run("short", minutes=60.0)
    for system in ("global", "sequential"):
        make_run(system, system=system, minutes=60.0)

    assert {row.runs[0].declared_budget for row in boards(tmp_path)[0].main_rows} == {"60 min cpu"}


def test_an_evaluation_on_other_data_is_named(make_run: MakeRun, tmp_path: Path):
    run = make_run("a")
    make_run("b", seed=1)
    change_json(run / "evaluation" / "metrics.json", data="elsewhere")
    [board] = boards(tmp_path)

    assert [row.name for row in board.rows if not row.is_main] == [f'vpd (evaluated_on="{"a" * 12}")']
    assert [row.runs[0].folder.name for row in board.main_rows] == ["b"]

    # A digest that is known decides, whatever the folders are called.
    for digest, is_other in (("a" * 64, False), ("b" * 64, True), (["b" * 64, "a" * 64], True)):
        change_json(run / "evaluation" / "metrics.json", training={"data_sha256": digest})
        [board] = boards(tmp_path)
        assert any("evaluated_on" in row.name for row in board.rows) is is_other


def test_settings_and_time_are_those_of_the_checkpoint(make_run: MakeRun, tmp_path: Path):
    run = make_run("a", minutes=60.0)
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["callbacks"]["time_budget"]["minutes"] = 90.0
    (run / "evaluation" / "config.yaml").write_text(yaml.safe_dump(config))
    change_json(run / "evaluation" / "metrics.json", training={"seconds": 60.0 * 80, "clock": "cpu"})
    [board] = boards(tmp_path)

    assert (board.runs[0].declared_budget, board.runs[0].minutes) == ("90 min cpu", 80.0)
    assert any("ended before their time budget" in words and "80.0 of 90" in words for words in table_warnings(board))


def test_unknown_times_and_other_checkpoints_are_told(make_run: MakeRun, tmp_path: Path):
    run = make_run("a")
    (run / "training_time.json").unlink()
    change_json(run / "evaluation" / "metrics.json", checkpoint="x/last.ckpt")
    change_json(make_run("b", system="global") / "evaluation" / "metrics.json", checkpoint="y/best.ckpt")

    words = " ".join(table_warnings(boards(tmp_path)[0]))

    assert f"not known how long these trained: {run}" in words
    assert "checkpoints was evaluated: global best.ckpt; vpd last.ckpt" in words


def test_what_sets_the_pace_counts_under_a_time_budget(make_run: MakeRun, tmp_path: Path):
    one = make_run("a", settings={"num_threads": 1})
    other = make_run("b", system="global", settings={"num_threads": 4})
    change_json(one / "environment.json", devices=["cpu: one"])
    change_json(other / "environment.json", devices=["cpu: other"])
    [board] = boards(tmp_path)

    words = " ".join(table_warnings(board))

    assert "did not compute alike: global num_threads=4; vpd num_threads=1" in words
    assert "different machines: global cpu: other; vpd cpu: one" in words
    make_run("a1", seed=1, settings={"num_threads": 2})
    assert len([row for row in boards(tmp_path)[0].rows if row.system == "vpd"]) == 2


def test_sharpness_is_ranked_by_its_ratio():
    distance = metric("sharpness").distance
    assert distance(0.5) == pytest.approx(distance(2.0)) and distance(0.4) > distance(2.0) > distance(1.1)
    assert distance(0.0) > 10
