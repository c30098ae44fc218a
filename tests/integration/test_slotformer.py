"""SlotFormer's two trainings by ``vpd-train``: what the first hands to the second, and that both belong together."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.data.recordings import write_recordings
from vpd_lightning.baselines.savi_system import SAViSystem
from vpd_lightning.baselines.slotformer_system import SlotFormerSystem
from vpd_lightning.commands import train
from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.data.manifest import file_sha256, load_manifest
from vpd_lightning.data.views.slot_store import SlotSource, SlotStore
from vpd_lightning.geometry.resizing import resize_images
from vpd_lightning.loading import load_model
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import ViewBatch

STEPS, FRAMES, RESOLUTION = 2, 9, 16


@pytest.fixture(scope="module")
def data_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("data"), num_train=2, num_frames=FRAMES)


def words(data_folder: Path, run: Path, model: str = "slotformer") -> list[str]:
    chosen = [
        f"model={model}", "budget=tiny", f"data.folder={data_folder}", f"run.folder={run}", "scene.input_views=[0]",
        f"trainer.max_steps={STEPS}", f"trainer.val_check_interval={STEPS}", "num_threads=1", "logger=csv",
        "callbacks.keep_checkpoints.every_n_steps=2", "callbacks.draw_rollouts=null", "force=true",
    ]  # fmt: skip
    return chosen if model == "savi" else [*chosen, f"pretraining.settings.trainer.max_steps={STEPS}"]


@pytest.fixture(scope="module")
def run(data_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run; not to be written into."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert train.main(words(data_folder, folder)) == 0
    return folder


def systems(run: Path) -> tuple[SAViSystem, SlotFormerSystem]:
    """The system of each training."""
    loaded = [load_model(folder / "checkpoints" / "last.ckpt", "cpu") for folder in (run / "pretraining", run)]
    savi, slotformer = (model.simulator for model in loaded)
    assert isinstance(savi, SAViSystem) and isinstance(slotformer, SlotFormerSystem)
    return savi, slotformer


def stored(run: Path, data_folder: Path) -> SlotStore:
    manifest = load_manifest(data_folder)
    source = SlotSource(file_sha256(run / "pretraining/checkpoints/last.ckpt"), manifest.digest, RESOLUTION)
    return SlotStore(run / "slots", manifest.folder, source)


def video(data_folder: Path, view: int) -> tuple[Path, Tensor]:
    """A training file and the frames of one of its cameras, as the systems see them."""
    path = load_manifest(data_folder).split("train")[1]
    full = TrajectoryFrames(path, use_cache=False).rgb(range(FRAMES), [view])
    return path, resize_images(torch.from_numpy(full), RESOLUTION)


def test_second_training_keeps_the_weights_of_the_first(run: Path) -> None:
    savi, slotformer = systems(run)
    first, second = savi.state_dict(), slotformer.state_dict()
    assert len(first) > 20 and all(torch.equal(value, second[name]) for name, value in first.items())
    assert any(name.startswith("rollouter.") for name in second)


def test_decoding_stored_slots_reconstructs_their_frames_as_savi_does(run: Path, data_folder: Path) -> None:
    savi, slotformer = systems(run)
    path, frames = video(data_folder, view=1)
    slots = stored(run, data_folder).read(path, 1, range(FRAMES))
    batch = ViewBatch(frames.transpose(0, 1), None, FRAMES, RandomKeys.fixed(1))
    with torch.no_grad():
        reconstruction = savi.eval()(batch).rendered.rgbs[0].unflatten(1, (RESOLUTION, RESOLUTION))

    # Stored slots were made several views at a time, which sums in another order.
    torch.testing.assert_close(slotformer.decode(slots), reconstruction.clamp(0, 1), rtol=0, atol=1e-5)
    other = stored(run, data_folder).read(path, 0, range(FRAMES))
    assert (slotformer.decode(other) - reconstruction.clamp(0, 1)).abs().max() > 1e-4


def test_slots_of_the_first_frames_are_those_that_a_rollout_begins_with(run: Path, data_folder: Path) -> None:
    _, slotformer = systems(run)
    path, frames = video(data_folder, view=0)
    history = slotformer.encode_views(frames[: slotformer.num_context_frames])[0]
    slots = stored(run, data_folder).read(path, 0, range(slotformer.num_context_frames))
    torch.testing.assert_close(slots, history, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_a_savi_trained_by_itself_is_handed_on_but_not_with_the_slots_of_another(
    run: Path, data_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    savi, second = tmp_path / "savi", tmp_path / "second"
    assert train.main([*words(data_folder, savi, model="savi"), "seed=1"]) == 0
    given = [*words(data_folder, second), f"pretraining.ckpt={savi}"]
    capsys.readouterr()

    assert train.main([*given, f"data.slot_folder={run / 'slots'}"]) == 4
    message = capsys.readouterr().err
    assert "holds slots of another checkpoint" in message and len(message.strip().splitlines()) <= 5
    assert not second.exists()
    assert train.main([*given, f"data.slot_folder={tmp_path / 'slots'}"]) == 0
    assert (tmp_path / "slots" / "slots.npy").is_file() and not (second / "pretraining").exists()
    first = load_model(savi / "checkpoints" / "last.ckpt", "cpu").simulator.state_dict()
    handed = load_model(second / "checkpoints" / "last.ckpt", "cpu").simulator.state_dict()
    assert all(torch.equal(value, handed[name]) for name, value in first.items())
