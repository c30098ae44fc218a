"""Trainings in two parts: what the first one says and does, and what reaches the second."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from vpd_lightning.commands.train import main
from vpd_lightning.config import compose, pretraining_config
from vpd_lightning.config.pretraining import FOLDER
from vpd_lightning.data.trained_on import TRAINED_ON
from vpd_lightning.errors import CheckpointError
from vpd_lightning.loading import load
from vpd_lightning.runs.first_training import DONE_FILE, load_pretrained
from vpd_lightning.training.checkpoint_files import load_checkpoint, write_checkpoint
from vpd_lightning.training.module import VPDModule

WORDS = ["experiment=mujoco_block", "model=sequential", "budget=tiny", "num_threads=1", "logger=none"]
SHORT = ["trainer.max_steps=4", "pretraining.settings.trainer.max_steps=3", "trainer.val_check_interval=100"]
BRIEF = ["protocol.num_trajectories=1", "protocol.num_steps=1", "protocol.num_long_steps=0"]  # of an evaluation


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from data_gen.generate import generate

    folder = tmp_path_factory.mktemp("tiny") / "data"
    generate(scene="mujoco_block", preset="tiny", out=folder, seed=0)
    return folder


def train(data: Path, run: Path, *words: str) -> int:
    return main([*WORDS, *SHORT, f"data.folder={data}", f"run.folder={run}", *words])


@pytest.fixture(scope="module")
def whole(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of both trainings, undisturbed; not to be changed."""
    run = tmp_path_factory.mktemp("whole") / "run"
    assert train(data, run) == 0
    return run


def sequential(**changes: Any) -> dict[str, Any]:
    return {**compose("train", [*WORDS, "run.folder=runs/here"]), **changes}


def test_first_configuration_is_the_main_one_with_its_settings_over_it() -> None:
    config = sequential()
    first = pretraining_config(config)

    assert first is not None
    assert first["pretraining"] is None and not first["evaluate"]
    assert first["model"]["_target_"].endswith("AutoEncoder")
    assert "num_points" not in first["model"]  # another class: none of the other's arguments
    assert first["dynamics"].keys() == {"_target_"}
    assert first["encoder"] == config["encoder"] and first["renderer"] == config["renderer"]
    assert first["loss"]["point_features"] is None and first["loss"]["pixel"]["weight"] == 1.0
    assert first["trainer"]["default_root_dir"] == str(Path(config["run"]["folder"]) / FOLDER)
    assert config["model"]["_target_"].endswith("SequentialSimulator")  # untouched


def test_first_training_gets_its_share_of_the_time() -> None:
    config = compose("train", ["experiment=mujoco_block", "model=sequential", "budget=minutes", "run.folder=x"])
    first = pretraining_config(config)

    assert first is not None
    minutes, share = config["callbacks"]["time_budget"]["minutes"], config["pretraining"]["share"]
    assert first["callbacks"]["time_budget"]["minutes"] == pytest.approx(minutes * share)
    assert pretraining_config(compose("train", ["experiment=mujoco_block", "run.folder=x"])) is None


@pytest.mark.slow
def test_second_training_starts_from_the_first_and_keeps_what_is_frozen(
    data: Path, whole: Path, tmp_path: Path
) -> None:
    run = whole
    assert (run / FOLDER / DONE_FILE).is_file()
    first = load_checkpoint(run / FOLDER / "checkpoints" / "last.ckpt")["state_dict"]
    second = load_checkpoint(run / "checkpoints" / "last.ckpt")["state_dict"]
    assert load_checkpoint(run / "checkpoints" / "last.ckpt")["global_step"] == 4
    assert all(torch.equal(second[name], value) for name, value in first.items())
    before, after = (
        json.loads((run / FOLDER / "training_time.json").read_text()),
        json.loads((run / "training_time.json").read_text()),
    )
    assert after["seconds_before"] == pytest.approx(before["seconds"], abs=0.01) and after["seconds_before"] > 0
    assert yaml.safe_load((run / "config.yaml").read_text())["pretraining"]["settings"]
    assert sum(parameter.requires_grad for parameter in load(run).parameters()) < len(list(load(run).parameters()))

    # An auto-encoder that is there already can be given.
    other = tmp_path / "other"
    assert train(data, other, f"pretraining.ckpt={run / FOLDER}", "data.num_trajectories=1") == 0
    assert not (other / FOLDER).exists()
    trained_on = load_checkpoint(other / "checkpoints" / "last.ckpt")[TRAINED_ON]
    assert len(trained_on) > 1, "what the first training saw counts"
    assert trained_on == load_checkpoint(run / FOLDER / "checkpoints" / "last.ckpt")[TRAINED_ON]
    given = load_checkpoint(other / "checkpoints" / "last.ckpt")["state_dict"]
    assert all(torch.equal(given[name], value) for name, value in first.items())


@pytest.mark.slow
def test_staged_vpd_learns_its_dynamics_by_pixels_through_what_the_first_training_left(
    data: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    assert train(data, run, "model=vpd_staged", "callbacks.keep_checkpoints.every_n_steps=1") == 0

    first = load_checkpoint(run / FOLDER / "checkpoints" / "last.ckpt")["state_dict"]
    before, after = (
        load_checkpoint(run / "checkpoints" / f"{name}.ckpt")["state_dict"] for name in ("last-previous", "last")
    )
    assert all(name.startswith("simulator.dynamics.") for name in after.keys() - first.keys())
    assert all(torch.equal(after[name], value) for name, value in first.items())
    assert not torch.equal(*(each["simulator.dynamics.decode_location.layers.3.weight"] for each in (before, after)))


@pytest.mark.slow
def test_training_goes_on_from_released_weights(data: Path, tmp_path: Path) -> None:
    released = Path(__file__).parents[2] / "released" / "mujoco_block_vpd"
    words = ["experiment=mujoco_block", "model=vpd_staged", "budget=hour", "evaluate=false", "trainer.max_steps=1"]
    small = ["data.batch_size=1", "data.num_steps=1", "data.num_steps_schedule=null", "data.rays_per_step=64"]
    places = [f"data.folder={data}", f"run.folder={tmp_path / 'run'}", f"pretraining.ckpt={released}"]

    assert main([*words, *small, *places, "num_threads=1", "logger=none", "data.num_validation_clips=0"]) == 0

    stored = load_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")
    found, before = stored["state_dict"], load(released).state_dict()
    frozen = [name for name in before if not name.startswith("dynamics.")]
    assert all(torch.equal(found[f"simulator.{name}"], before[name]) for name in frozen)
    assert not torch.equal(
        *(
            weights["dynamics.decode_location.layers.3.weight"]
            for weights in (before, {name.removeprefix("simulator."): value for name, value in found.items()})
        )
    )
    index = json.loads((released / "release.json").read_text())
    assert set(index[TRAINED_ON]) < set(stored[TRAINED_ON])


@pytest.mark.slow
def test_run_that_ended_between_the_two_trainings_goes_on(data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert train(data, run) == 0
    expected = load_checkpoint(run / "checkpoints" / "last.ckpt")["state_dict"]
    for path in (run / "checkpoints").iterdir():
        path.unlink()
    (run / FOLDER / DONE_FILE).unlink()

    assert main([f"resume={run}"]) == 0
    found = load_checkpoint(run / "checkpoints" / "last.ckpt")["state_dict"]
    assert all(torch.equal(found[name], value) for name, value in expected.items())


@pytest.mark.slow
def test_run_killed_in_its_first_training_goes_on_there_and_is_evaluated(
    data: Path, whole: Path, tmp_path: Path
) -> None:
    killed = tmp_path / "killed"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(VPDModule, "on_train_batch_start", dies_at_step(2), raising=False)
        with pytest.raises(RuntimeError, match="killed"):
            train(data, killed, "callbacks.keep_checkpoints.every_n_steps=1", "evaluate=true", *BRIEF)
    assert not (killed / FOLDER / DONE_FILE).exists() and not (killed / "checkpoints").exists()

    assert main([f"resume={killed}"]) == 0

    expected, found = (load_checkpoint(run / "checkpoints" / "last.ckpt") for run in (whole, killed))
    assert found["global_step"] == expected["global_step"] == 4
    assert all(torch.equal(found["state_dict"][name], value) for name, value in expected["state_dict"].items())
    figures = json.loads((killed / "evaluation" / "metrics.json").read_text())
    last = (killed / "checkpoints" / "last.ckpt").read_bytes()
    assert figures["checkpoint_sha256"] == hashlib.sha256(last).hexdigest()


def dies_at_step(step: int) -> Callable[..., None]:
    """Stand for a kill between two updates: what the last checkpoint does not hold is lost."""

    def die(module: VPDModule, batch: Any, batch_index: int) -> None:
        if module.global_step >= step:
            raise RuntimeError("killed")

    return die


def test_weights_without_a_place_are_refused(tmp_path: Path) -> None:
    from tests.training.tiny_training import tiny_simulator

    simulator = tiny_simulator()
    state = {f"simulator.{name}": value for name, value in simulator.state_dict().items()}
    path = tmp_path / "last.ckpt"
    write_checkpoint({"state_dict": {**state, "simulator.other.weight": torch.zeros(2)}}, path)
    with pytest.raises(CheckpointError, match=r"other\.weight"):
        load_pretrained(simulator, path, {})

    name = next(iter(state))
    write_checkpoint({"state_dict": {name: torch.zeros(1, 2, 3)}}, path)
    with pytest.raises(CheckpointError, match="does not fit"):
        load_pretrained(simulator, path, {})


def test_weights_of_other_settings_and_frozen_weights_without_an_origin_are_refused(tmp_path: Path) -> None:
    from tests.training.tiny_training import tiny_simulator

    simulator, path = tiny_simulator(), tmp_path / "last.ckpt"
    state = {f"simulator.encoder.{name}": value for name, value in simulator.encoder.state_dict().items()}
    ignored = {"ray_chunk_size": 1, "num_particles": 1, "x_backend": "a"}
    first = {"encoder": {"size": {"width": 8}, **ignored}, "renderer": {"samples": 1}}
    write_checkpoint({"state_dict": state, "hyper_parameters": first}, path)

    ignored = {"ray_chunk_size": 2, "num_particles": 2, "x_backend": "b"}
    second = {"encoder": {"size": {"width": 8}, **ignored}, "renderer": {"samples": 2}}
    load_pretrained(simulator, path, second)  # no weight of the renderer is taken
    with pytest.raises(CheckpointError, match=r"encoder\.size\.width=8, but the second training has 9"):
        load_pretrained(simulator, path, {**second, "encoder": {"size": {"width": 9}}})

    simulator.encoder.requires_grad_(False)
    load_pretrained(simulator, path, second)
    simulator.renderer.requires_grad_(False)
    with pytest.raises(CheckpointError, match="lacks renderer"):
        load_pretrained(simulator, path, second)
