"""A budget changes what an experiment costs, never what it is about."""

import functools
from typing import Any

import pytest

from data_gen.settings import load_preset
from vpd_lightning.config import build_simulator, check_targets, check_widths, compose, config_folder

EXPERIMENTS = sorted(path.stem for path in (config_folder() / "experiment").glob("*.yaml"))
OF_THE_PAPER = [name for name in EXPERIMENTS if name not in ("tiny", "demo", "recordings", "pushing")]
SECTIONS = ("model", "data", "encoder", "dynamics", "renderer", "loss", "optimizer", "trainer", "callbacks", "logger")
STAGES = {"encoder": "unet_small", "dynamics": "hierarchical_gnn_small", "renderer": "point_nerf_small"}


@functools.cache
def trained(*words: str) -> dict[str, Any]:
    """The composed configuration; not to be changed."""
    return compose("train", [*words, "run.folder=nowhere"])


def test_every_data_set_of_the_paper_has_an_experiment():
    assert OF_THE_PAPER == [
        "deformable_block", "deformable_collision", "deformable_multi",
        "movi_a", "movi_a_high", "movi_b", "movi_c", "movi_c_high", "mujoco_block",
    ]  # fmt: skip


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_papers_budget_changes_nothing(experiment: str):
    assert trained(f"experiment={experiment}", "budget=paper") == trained(f"experiment={experiment}")


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_tiny_budget_makes_any_experiment_small(experiment: str):
    config = trained(f"experiment={experiment}", "budget=tiny")

    for section in SECTIONS:
        check_targets(config[section], section)
    check_widths(config)
    if experiment not in ("demo", "recordings"):  # whose system is not the paper's
        for stage, option in STAGES.items():
            alone = trained(f"{stage}={option}", "data.folder=any")
            assert config[stage]["_target_"] == alone[stage]["_target_"]
    assert config["encoder"]["num_particles"] == 256
    assert config["trainer"]["accelerator"] == "cpu"
    assert config["trainer"]["max_steps"] == 20
    assert config["protocol"]["num_steps"] == 4
    assert sum(parameter.numel() for parameter in build_simulator(config).parameters()) < 200_000


@pytest.mark.parametrize("experiment", OF_THE_PAPER)
def test_tiny_budget_keeps_the_world_and_makes_its_tiny_data(experiment: str):
    paper, tiny = trained(f"experiment={experiment}"), trained(f"experiment={experiment}", "budget=tiny")

    assert tiny["scene"] == paper["scene"]
    assert tiny["experiment"] == experiment
    assert tiny["data"]["folder"] == f"datasets/{experiment}_tiny"
    assert tiny["generate"] == {"scene": experiment, "preset": "tiny", "seed": 0, "when_missing": True}
    assert paper["data"]["folder"] == f"datasets/{experiment}"
    assert paper["generate"] == {"scene": experiment, "preset": "paper", "seed": 0, "when_missing": False}


@pytest.mark.parametrize("experiment", OF_THE_PAPER)
def test_generated_data_fit_the_experiment(experiment: str):
    config = trained(f"experiment={experiment}")
    scene, protocol = config["scene"], config["protocol"]
    paper, small, tiny = (load_preset(experiment, preset)[1] for preset in ("paper", "small", "tiny"))

    for key in ("near", "far", "workspace_min", "workspace_max"):
        assert paper[key] == small[key] == scene[key], key
    assert tiny.splits == {"train": 4, "validation": 2, "test": 2}
    assert min(tiny.camera.height, tiny.camera.width) >= 64
    for preset in (paper, tiny):  # the paper's own settings work on the tiny set, too
        assert preset.camera.num_views >= max(4, *[view + 1 for view in scene["input_views"]])
        assert preset.num_frames >= max(protocol["start_frames"]) + 2 + protocol["num_steps"]


def test_order_of_the_words_does_not_matter():
    assert trained("budget=tiny", "experiment=movi_a") == trained("experiment=movi_a", "budget=tiny")


def test_words_of_the_command_line_win_over_the_budget():
    config = trained("experiment=demo", "budget=tiny", "renderer=splat", "encoder.num_particles=99", "data.folder=mine")

    assert config["renderer"]["_target_"].endswith("SplatRenderer")
    assert config["encoder"]["num_particles"] == 99
    assert config["data"]["folder"] == "mine"


def test_tiny_budget_serves_recordings_of_ones_own():
    config = trained("budget=tiny", "data.folder=mine", "scene.input_views=[0]")

    assert config["generate"]["scene"] is None
    assert config["data"]["input_views"] == [0]
