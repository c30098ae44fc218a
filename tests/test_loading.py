"""Loading a trained model: only whole checkpoints of ours, with plain configurations, on devices that are there."""

from pathlib import Path

import pytest
import torch

import vpd_lightning
from tests.evaluation.untrained_model import write_untrained
from vpd_lightning.errors import CheckpointError, ConfigError
from vpd_lightning.loading import find_device, load_model
from vpd_lightning.training.checkpoint_io import load_checkpoint, write_checkpoint


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
