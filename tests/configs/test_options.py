"""Every option of every group composes and fits the class it names."""

import inspect
from importlib import import_module
from pathlib import Path

import pytest

from tests.composed_options import option_section, options
from vpd_lightning.config import build_simulator, check_targets, check_widths, compose, config_folder
from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.errors import ConfigError

EXPERIMENTS = sorted(path.stem for path in (config_folder() / "experiment").glob("*.yaml"))
GROUPS = ("scene", "encoder", "dynamics", "renderer", "optimizer", "trainer", "callbacks", "logger", "protocol")
OPTIONS = [f"{group}={option}" for group in GROUPS for option in options(group)]
SECTIONS = ("model", "data", "encoder", "dynamics", "renderer", "loss", "optimizer", "trainer", "callbacks", "logger")
PLACED = ["data.folder=nowhere", "run.folder=nowhere"]


def test_configuration_lies_where_the_code_looks_for_it():
    assert (config_folder() / "train.yaml").is_file()
    assert config_folder().is_absolute()


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_experiment_names_itself_and_its_classes_take_its_arguments(experiment: str):
    config = compose("train", [f"experiment={experiment}", *PLACED])

    assert config["experiment"] == experiment
    for section in SECTIONS:
        check_targets(config[section], section)
    check_widths(config)


@pytest.mark.parametrize("option", OPTIONS)
def test_option_fits_the_class_it_names(option: str):
    if option == "logger=wandb":
        pytest.importorskip("wandb")
    group, _, name = option.partition("=")
    others = [each for each in GROUPS if each != "scene"]  # whose sections refer to that of the scene
    section = option_section(group, name, ["scene"] if group == "scene" else others, PLACED)

    check_targets(section, group)
    if group in ("encoder", "dynamics", "renderer", "optimizer"):  # a value has one home, and that is conf/
        module, _, class_name = section["_target_"].rpartition(".")
        for parameter in inspect.signature(getattr(import_module(module), class_name)).parameters.values():
            assert parameter.default is parameter.empty, f"{class_name}.{parameter.name} has a default"


@pytest.mark.parametrize("experiment", ["tiny", "demo"])
def test_small_experiment_builds_a_simulator(experiment: str):
    simulator = build_simulator(compose("train", [f"experiment={experiment}"]))

    assert isinstance(simulator.dynamics, AbstractDynamics)
    assert sum(parameter.numel() for parameter in simulator.parameters()) > 1000


def test_simulator_can_be_rebuilt_from_the_plain_configuration_alone():
    config = compose("train", ["experiment=tiny"])
    config = {key: config[key] for key in ("model", "encoder", "dynamics", "renderer")}

    assert build_simulator(config).encoder.num_particles == config["encoder"]["num_particles"]


def test_feature_width_is_set_once_for_all_stages():
    config = compose("train", ["experiment=tiny", "feature_dim=24"])

    assert config["encoder"]["channels"][-1] == config["dynamics"]["feature_dim"] == 24
    assert config["renderer"]["feature_dim"] == 24
    check_widths(config)


def test_unequal_feature_widths_are_refused():
    config = compose("train", ["experiment=tiny", "renderer.feature_dim=8"])

    with pytest.raises(ConfigError, match=r"disagree.*\n.*renderer.feature_dim=8"):
        build_simulator(config)


def test_stages_that_disagree_about_colours_among_the_features_are_refused():
    config = compose("train", ["experiment=tiny", "model=inertial", "renderer.color_features=false"])

    with pytest.raises(ConfigError, match=r"disagree.*\nencoder.color_features=true, renderer.color_features=false"):
        build_simulator(config)


def test_further_options_come_from_a_folder_of_ones_own(tmp_path: Path):
    (tmp_path / "encoder").mkdir()
    (tmp_path / "encoder" / "mine.yaml").write_text("defaults: [unet_small, _self_]\nnum_particles: 77\n")

    config = compose("train", ["experiment=tiny", "encoder=mine"], config_dir=tmp_path)

    assert config["encoder"]["num_particles"] == 256  # the experiment's own value still wins
    config = compose("train", ["encoder=mine", *PLACED], config_dir=tmp_path)
    assert config["encoder"]["num_particles"] == 77


def test_composing_leaves_a_running_hydra_alone():
    from hydra.core.global_hydra import GlobalHydra

    compose("train", ["experiment=tiny"])

    assert not GlobalHydra.instance().is_initialized()
