"""What belongs to a sweep, and where its runs go."""

import functools
import re
from pathlib import Path

import pytest

from vpd_lightning.config import check_targets, check_widths, compose, config_folder, expand_sweep
from vpd_lightning.config.run_folders import sweep_folder, sweep_slug
from vpd_lightning.runs.sweeps import sweep_jobs

SWEEPS = sorted(path.stem for path in (config_folder() / "sweep").glob("*.yaml"))
SECTIONS = ("model", "data", "encoder", "dynamics", "renderer", "loss", "optimizer", "trainer", "callbacks", "logger")
NUM_JOBS = {
    "features": 3, "high_cameras": 4, "input_views": 9, "normalization": 3, "particles": 5, "persistence": 7,
    "predicted_depth": 2, "rollout_length_noise": 12, "sparsity": 20, "table2": 28,
}  # fmt: skip


@functools.cache
def jobs_of(*words: str) -> list[list[str]]:
    """The words of each job; not to be changed."""
    return expand_sweep("train", words)


def test_every_comparison_of_the_paper_is_a_sweep():
    assert NUM_JOBS.keys() <= set(SWEEPS)


@pytest.mark.parametrize("sweep", SWEEPS)
def test_sweep_has_as_many_jobs_as_the_paper_compares(sweep: str):
    jobs = jobs_of(f"sweep={sweep}")

    assert len(jobs) == NUM_JOBS.get(sweep, len(jobs))
    assert len({tuple(job) for job in jobs}) == len(jobs)


def jobs_that_show_every_word(sweep: str, budget: str) -> list[list[str]]:
    """Choose jobs so that each word of the sweep is in one of them: all 28 of table2 would take long to compose."""
    seen: set[str] = set()
    chosen = []
    jobs = jobs_of(f"sweep={sweep}")
    assert not any(word.startswith("budget=") for words in jobs for word in words)
    for words in ([*words, f"budget={budget}"] for words in jobs):
        if not seen.issuperset(words):
            chosen.append(words)
        seen.update(words)
    return chosen


@pytest.mark.slow
@pytest.mark.parametrize("sweep", SWEEPS)
def test_every_word_of_a_sweep_composes_and_fits_its_classes(sweep: str):
    # Recipes and budgets have tests of their own: under the paper's budget one job of each sweep is enough.
    jobs = [*jobs_that_show_every_word(sweep, "minutes"), jobs_that_show_every_word(sweep, "paper")[0]]
    configs = [compose("train", [*words, "run.folder=chosen"]) for words in jobs]

    for config in configs:
        assert config["evaluate"] and config["sweep_name"] == sweep
        for section in SECTIONS:
            check_targets(config[section], section)
        check_widths(config)
    different = {
        str({key: value for key, value in config.items() if key not in ("run", "system")}) for config in configs
    }
    assert len(different) == len(configs)  # no budget takes away what a sweep is about


@pytest.mark.slow
@pytest.mark.exhaustive  # each system and each data set is in a job of table2 above
def test_every_system_fits_every_data_set_within_minutes():
    jobs = sweep_jobs(["sweep=table2", "budget=minutes"], None)

    assert len({job.folder for job in jobs}) == len(jobs) == NUM_JOBS["table2"]
    for job in jobs:
        check_widths(job.config)


@pytest.mark.parametrize("sweep", SWEEPS)
def test_every_job_of_a_sweep_has_a_place_of_its_own(sweep: str):
    jobs = jobs_of(f"sweep={sweep}")
    parameters = sorted({word.partition("=")[0] for words in jobs for word in words} - {"experiment"})

    places = {(*(word for word in words if "experiment=" in word), sweep_slug(words, parameters)) for words in jobs}

    assert len(places) == len(jobs)


def test_job_knows_the_folder_of_its_sweep_and_its_own_inside():
    (job,) = sweep_jobs(["sweep=table2", "experiment=movi_a", "model=vpd", "budget=minutes"], None)

    assert job.sweep_folder == Path.cwd() / "runs" / "sweeps" / "table2"
    assert job.folder == job.sweep_folder / "movi_a" / "model-vpd__budget-minutes"


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
