"""Loading a trained model: only whole checkpoints of ours, with plain configurations, on devices that are there."""

import inspect
import re
from importlib import import_module
from pathlib import Path

import pytest
import torch

import vpd_lightning
from tests.evaluation.untrained_model import write_untrained
from vpd_lightning.config.migrations import ADDED_SETTINGS, REMOVED_SETTINGS
from vpd_lightning.dynamics.sleeping import SleepingDynamics
from vpd_lightning.errors import CheckpointError, ConfigError
from vpd_lightning.loading import find_device, load_model
from vpd_lightning.training.checkpoint_files import load_checkpoint, write_checkpoint


def test_a_model_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    path = write_untrained(tmp_path / "run", tmp_path)
    simulator = vpd_lightning.load(path)
    weights = load_checkpoint(path)["state_dict"]
    assert not simulator.training
    for name, value in simulator.state_dict().items():
        assert torch.equal(value, weights[f"simulator.{name}"])


def test_a_run_folder_means_its_newest_checkpoint(tmp_path: Path) -> None:
    path = write_untrained(tmp_path / "run", tmp_path)
    model = load_model(tmp_path / "run")
    assert model.path == path and model.step == 7 and model.input_views == [0]


def test_a_checkpoint_without_configuration_is_refused(tmp_path: Path) -> None:
    write_checkpoint({"state_dict": {}}, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match="does not say what model it holds"):
        load_model(tmp_path / "a.ckpt")


def test_a_configuration_that_names_foreign_code_is_refused(tmp_path: Path) -> None:
    path = write_untrained(tmp_path / "run", tmp_path)
    content = load_checkpoint(path)
    content["hyper_parameters"]["encoder"] = {"_target_": "os.system", "command": f"touch {tmp_path}/hacked"}
    write_checkpoint(content, path)
    with pytest.raises(CheckpointError, match="cannot build"):
        load_model(path)
    assert not (tmp_path / "hacked").exists()


@pytest.mark.parametrize("section", ["encoder", "model", "scene", "data"])
@pytest.mark.parametrize("payload", ["${oc.create:{_target_:os.mkdir,path:FOLDER}}", "${oc.env:HOME}"])
def test_a_configuration_with_a_reference_is_refused(tmp_path: Path, section: str, payload: str) -> None:
    """Hydra would resolve it after the check of what may be built, to whatever it says."""
    path = write_untrained(tmp_path / "run", tmp_path)
    content = load_checkpoint(path)
    values = content["hyper_parameters"][section]
    name = next((name for name in values if name != "_target_"), "more")
    values[name] = payload.replace("FOLDER", str(tmp_path / "hacked"))
    write_checkpoint(content, path)
    with pytest.raises(CheckpointError, match=f"may not be loaded.\nhyper_parameters.{section}.{name} holds a ref"):
        load_model(path, sleeping=True)
    assert not (tmp_path / "hacked").exists()


def test_weights_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = write_untrained(tmp_path / "run", tmp_path)
    content = load_checkpoint(path)
    content["state_dict"].popitem()
    write_checkpoint(content, path)
    with pytest.raises(CheckpointError, match="do not fit"):
        load_model(path)


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04" + bytes(200)])
def test_what_is_no_checkpoint_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.ckpt").write_bytes(content)
    with pytest.raises(CheckpointError, match=r"a\.ckpt"):
        vpd_lightning.load(tmp_path / "a.ckpt")


@pytest.mark.parametrize("device", ["cuda:77", "tpu9", "nonsense"])
def test_devices_that_are_not_there_are_refused(device: str) -> None:
    with pytest.raises(ConfigError, match="device=cpu"):
        find_device(device)


def test_settings_that_came_later_mean_what_older_checkpoints_did(tmp_path: Path) -> None:
    path = write_untrained(tmp_path / "run", tmp_path)
    content = load_checkpoint(path)
    renderer = content["hyper_parameters"]["renderer"]
    added = ADDED_SETTINGS[renderer["_target_"]]
    for name in added:
        del renderer[name]
    write_checkpoint(content, path)
    loaded = load_model(path).config["renderer"]
    assert {name: loaded[name] for name in added} == added


def arguments_of(target: str) -> set[str]:
    module, name = target.rsplit(".", 1)
    return set(inspect.signature(getattr(import_module(module), name)).parameters)


def test_every_added_setting_is_an_argument_of_its_class_and_no_removed_one_is() -> None:
    for target, settings in ADDED_SETTINGS.items():
        assert set(settings) <= arguments_of(target), target
    for target, settings in REMOVED_SETTINGS.items():
        assert not set(settings) & arguments_of(target), target


def with_settings(path: Path, section: str, **settings: object) -> Path:
    content = load_checkpoint(path)
    content["hyper_parameters"][section].update(settings)
    write_checkpoint(content, path)
    return path


def test_settings_that_are_gone_are_left_out_where_they_were_off(tmp_path: Path) -> None:
    path = write_untrained(tmp_path / "run", tmp_path)
    expected = load_model(path).config
    with_settings(path, "renderer", early_stop=0.0, num_stop_segments=7, share_rows_below=None)
    assert load_model(path).config == expected


@pytest.mark.parametrize("setting", [{"early_stop": 1e-3}, {"share_rows_below": 0.0}])
def test_a_setting_that_is_gone_and_was_on_is_refused_by_name(tmp_path: Path, setting: dict) -> None:
    path = with_settings(write_untrained(tmp_path / "run", tmp_path), "renderer", **setting)
    with pytest.raises(CheckpointError, match=rf"renderer\.{next(iter(setting))}=.* no longer has"):
        load_model(path)


def test_a_class_that_is_gone_is_refused_by_name(tmp_path: Path) -> None:
    path = write_untrained(tmp_path / "run", tmp_path)
    with_settings(path, "dynamics", _target_="vpd_lightning.dynamics.velocity_gnn.VelocityGNNDynamics")
    with pytest.raises(CheckpointError, match=r"dynamics is a .*VelocityGNNDynamics, which this version no longer has"):
        load_model(path)


def test_settings_of_a_trained_model_can_be_changed(tmp_path: Path) -> None:
    path = write_untrained(tmp_path / "run", tmp_path)
    before = load_model(path)
    after = load_model(path, change={"renderer": {"ray_chunk_size": 7}})
    assert after.simulator.renderer.ray_chunk_size == 7 != before.simulator.renderer.ray_chunk_size
    assert after.config["renderer"] == {**before.config["renderer"], "ray_chunk_size": 7}
    for name, value in after.simulator.state_dict().items():
        assert torch.equal(value, before.simulator.state_dict()[name])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"rendrer": {"near": 1.0}}, "Did you mean change.renderer?"),
        ({"renderer": {"neer": 1.0}}, "Did you mean change.renderer.near?"),
        ({"renderer": 3}, "change.renderer=3 is no section"),
        ({"renderer": {"near": 100.0}}, "near and far"),
        ({"renderer": {"net_width": 8}}, "asks for other weights"),
    ],
)
def test_changes_that_cannot_be_are_refused(tmp_path: Path, change: dict, said: str) -> None:
    path = write_untrained(tmp_path / "run", tmp_path)
    with pytest.raises(ConfigError, match=re.escape(said)):
        load_model(path, change=change)


def test_a_model_trained_awake_can_sleep(tmp_path: Path) -> None:
    path = write_untrained(tmp_path / "run", tmp_path)
    model = load_model(path, change={"dynamics": {"rest_steps": 5}}, sleeping=True)
    assert isinstance(model.simulator.dynamics, SleepingDynamics) and model.simulator.dynamics.rest_steps == 5
    for name, value in load_model(path).simulator.state_dict().items():
        assert torch.equal(value, model.simulator.state_dict()[name])
