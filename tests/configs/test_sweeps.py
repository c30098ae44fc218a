"""What belongs to a sweep, and where its runs go."""

import re
from pathlib import Path

import pytest

from vpd_lightning.commands.sweeps import sweep_jobs
from vpd_lightning.config import check_targets, check_widths, config_folder, expand_sweep
from vpd_lightning.config.run_folders import sweep_folder, sweep_slug

SWEEPS = sorted(path.stem for path in (config_folder() / "sweep").glob("*.yaml"))
SECTIONS = ("model", "data", "encoder", "dynamics", "renderer", "loss", "optimizer", "trainer", "callbacks", "logger")
NUM_JOBS = {
    "features": 3, "high_cameras": 4, "input_views": 9, "normalization": 3, "particles": 5, "persistence": 7,
    "predicted_depth": 2, "rollout_length_noise": 12, "sparsity": 20, "table2": 28,
}  # fmt: skip


def test_every_comparison_of_the_paper_is_a_sweep():
    assert NUM_JOBS.keys() <= set(SWEEPS)


@pytest.mark.parametrize("sweep", SWEEPS)
def test_sweep_has_as_many_jobs_as_the_paper_compares(sweep: str):
    jobs = expand_sweep("train", [f"sweep={sweep}"])

    assert len(jobs) == NUM_JOBS.get(sweep, len(jobs))
    assert len({tuple(job) for job in jobs}) == len(jobs)


@pytest.mark.slow
@pytest.mark.parametrize("budget", ["paper", "minutes"])
@pytest.mark.parametrize("sweep", SWEEPS)
def test_every_job_composes_fits_its_classes_and_has_a_place_of_its_own(sweep: str, budget: str):
    jobs = sweep_jobs([f"sweep={sweep}", f"budget={budget}"], None)

    assert len({job.folder for job in jobs}) == len(jobs)
    for job in jobs:
        assert job.sweep_folder == Path.cwd() / "runs" / "sweeps" / sweep
        assert job.folder.parent == job.sweep_folder / job.config["experiment"]
        assert job.config["evaluate"]
        for section in SECTIONS:
            check_targets(job.config[section], section)
        check_widths(job.config)
    different = {str({key: value for key, value in job.config.items() if key not in ("run", "system")}) for job in jobs}
    assert len(different) == len(jobs)  # no budget takes away what a sweep is about


def test_command_line_narrows_a_sweep_and_adds_to_it():
    words = expand_sweep("train", ["sweep=sparsity", "model=vpd,global", "data.num_trajectories=32", "seed=1,2"])

    assert words == [
        ["experiment=mujoco_block", f"model={model}", "data.num_trajectories=32", "sweep=sparsity", f"seed={seed}"]
        for model in ("vpd", "global") for seed in (1, 2)
    ]  # fmt: skip


def test_sweep_of_lists_has_one_value_per_list():
    words = expand_sweep("train", ["sweep=input_views", "scene.input_views=[0],[0,5]"])

    assert [job[1] for job in words] == ["scene.input_views=[0]", "scene.input_views=[0,5]"]


def test_sweep_without_a_name_is_what_the_command_line_says():
    assert expand_sweep("train", ["seed=1,2", "experiment=tiny"]) == [
        ["seed=1", "experiment=tiny"], ["seed=2", "experiment=tiny"],
    ]  # fmt: skip


def test_place_is_readable_and_does_not_depend_on_the_order_of_words():
    words = ["sweep=s", "budget=minutes", "model=vpd", "data.num_trajectories=16", "experiment=tiny", "num_threads=1"]

    assert sweep_slug(words, ["model"]) == "model-vpd__budget-minutes__data.num_trajectories-16"
    assert sweep_slug(words[::-1], ["model"]) == sweep_slug(words, ["model"])
    assert sweep_slug(["run.root=/a", "hydra/job_logging=none", "resume=auto"], []) == "default"
    assert sweep_folder("runs", "s") == Path.cwd() / "runs" / "sweeps" / "s"


def test_different_words_have_different_places_however_long_or_odd_they_are():
    odd = ["data.folder=a/b", "data.folder=a,b", "data.folder=a-b", "data.folder=[a,b]", "data.folder='a b'"]
    long = [f"data.folder={'a' * 300}{number}" for number in range(3)]
    slugs = [sweep_slug([word], []) for word in odd + long]

    assert len(set(slugs)) == len(slugs)
    assert all(re.fullmatch(r"[\w.-]{1,120}", slug) for slug in slugs)
