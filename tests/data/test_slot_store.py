"""Stored slots: the right rows for each camera's frames, and nothing that comes from other weights or pictures."""

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.data.recordings import write_recordings
from vpd_lightning.config import compose
from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.views.slot_extraction import VIEWS_AT_ONCE, encoder_of, extract_slots, wait_for_slots
from vpd_lightning.data.views.slot_store import ARRAY_FILE, INDEX_FILE, SlotSource, SlotStore
from vpd_lightning.data.views.view_datamodule import FOLDER, ViewDataModule
from vpd_lightning.errors import CheckpointError, DataError, NonFiniteError

NUM_SLOTS, DIM, FRAMES, VIEWS, RESOLUTION = 3, 5, 8, 6, 16  # as the recordings: nothing is rounded


def known_slots(rgb: Tensor) -> Tensor:
    """Slots that tell their pictures apart, and that depend on all frames before (as SAVi's do)."""
    seen = rgb.double().mean(dim=(2, 3)).cumsum(dim=0).permute(1, 0, 2).sum(-1)  # view time
    return (seen[..., None, None] * torch.arange(1, NUM_SLOTS * DIM + 1).reshape(NUM_SLOTS, DIM)).float()


@pytest.fixture(scope="module")
def data_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("data"), num_train=3, num_views=VIEWS, num_frames=FRAMES)


@pytest.fixture(scope="module")
def trajectories(data_folder: Path) -> list[TrajectoryFrames]:
    return [TrajectoryFrames(path, use_cache=False) for path in load_manifest(data_folder).split("train")]


@pytest.fixture(scope="module")
def source(data_folder: Path) -> SlotSource:
    return SlotSource("a" * 64, load_manifest(data_folder).digest, RESOLUTION)


@pytest.fixture(scope="module")
def stored(data_folder: Path, trajectories: list[TrajectoryFrames], source: SlotSource, tmp_path_factory: Any) -> Path:
    folder = tmp_path_factory.mktemp("store") / "slots"
    extract(folder, data_folder, trajectories, source)
    return folder


def extract(
    folder: Path,
    data_folder: Path,
    trajectories: list[TrajectoryFrames],
    source: SlotSource,
    encode: Callable[[Tensor], Tensor] = known_slots,
) -> None:
    extract_slots(
        encode=encode,
        trajectories=trajectories,
        views=range(VIEWS),
        data_folder=load_manifest(data_folder).folder,
        folder=folder,
        source=source,
    )


def opened(stored: Path, data_folder: Path, source: SlotSource, **changes: Any) -> SlotStore:
    return SlotStore(stored, load_manifest(data_folder).folder, SlotSource(**{**source.__dict__, **changes}))


def test_every_frame_of_every_camera_is_where_it_belongs(
    stored: Path, data_folder: Path, trajectories: list[TrajectoryFrames], source: SlotSource
) -> None:
    store = opened(stored, data_folder, source)
    assert VIEWS > VIEWS_AT_ONCE  # more than one call of the encoder for a trajectory
    everything = set()
    for trajectory in trajectories:
        for view in range(VIEWS):
            full = torch.from_numpy(trajectory.rgb(range(FRAMES), [view]))
            slots = store.read(trajectory.path, view, range(FRAMES))
            assert torch.equal(slots, known_slots(full)[0])
            assert torch.equal(store.read(trajectory.path, view, [5, 2]), slots[[5, 2]])
            everything.add(float(slots.sum()))
    assert len(everything) == len(trajectories) * VIEWS


def test_a_store_that_was_sent_to_another_process_reads_the_same(
    stored: Path, data_folder: Path, trajectories: list[TrajectoryFrames], source: SlotSource
) -> None:
    store = opened(stored, data_folder, source)
    expected = store.read(trajectories[1].path, 2, [3])
    packed = pickle.dumps(store)
    assert len(packed) < 10_000  # not the slots themselves
    assert torch.equal(pickle.loads(packed).read(trajectories[1].path, 2, [3]), expected)


def test_slots_of_another_checkpoint_are_refused(stored: Path, data_folder: Path, source: SlotSource) -> None:
    with pytest.raises(CheckpointError, match=r"slots of another checkpoint \(SHA-256 aaaaaaaaaaaa.*bbbbbbbbbbbb"):
        opened(stored, data_folder, source, checkpoint_sha256="b" * 64)


def test_slots_of_other_pictures_are_refused(stored: Path, data_folder: Path, source: SlotSource) -> None:
    with pytest.raises(DataError, match="of another data set"):
        opened(stored, data_folder, source, data_digest="c" * 64)
    with pytest.raises(DataError, match="of 16 pixels, but data.resolution is 8"):
        opened(stored, data_folder, source, resolution=8)


def test_videos_and_frames_that_are_not_stored_are_refused(
    stored: Path, data_folder: Path, trajectories: list[TrajectoryFrames], source: SlotSource
) -> None:
    store = opened(stored, data_folder, source)
    with pytest.raises(DataError, match=r"no slots of train/000000.h5, camera 6"):
        store.read(trajectories[0].path, VIEWS, [0])
    with pytest.raises(DataError, match="8 frames of train/000000.h5, camera 0, but frame 8 is asked for"):
        store.read(trajectories[0].path, 0, [7, 8])
    with pytest.raises(DataError, match="8 frames of 000001.h5, camera 0, which has 9"):
        store.require(trajectories[1].path, [0], 9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda index: index.update(store_version=2), "not an index of version 1"),
        (lambda index: index.pop("num_slots"), "not an index of version 1"),
        (lambda index: index.update(num_slots=4), r"float32 of shape \(144, 3, 5\), but its index says .*144, 4, 5"),
        (lambda index: index["videos"].pop(), r"its index says float32 \(136, 3, 5\)"),
        (lambda index: index["videos"].pop(0), "rows of train/000000.h5, camera 1, are not behind"),
        (lambda index: index.update(videos=[["a", 0]]), "cannot be read: not enough values"),
    ],
)
def test_an_index_that_does_not_fit_is_refused(
    stored: Path, data_folder: Path, source: SlotSource, tmp_path: Path, change: Any, message: str
) -> None:
    copy = Path(shutil.copytree(stored, tmp_path / "copy"))
    index = json.loads((copy / INDEX_FILE).read_text())
    change(index)
    (copy / INDEX_FILE).write_text(json.dumps(index))
    with pytest.raises(DataError, match=message):
        opened(copy, data_folder, source)


@pytest.mark.parametrize("damage", ["cut", "text", "gone", "index"])
def test_damaged_files_are_refused(
    stored: Path, data_folder: Path, source: SlotSource, tmp_path: Path, damage: str
) -> None:
    copy = Path(shutil.copytree(stored, tmp_path / "copy"))
    array = copy / ARRAY_FILE
    if damage == "cut":
        array.write_bytes(array.read_bytes()[:-100])
    elif damage == "text":
        array.write_text("no array")
    elif damage == "gone":
        array.unlink()
    else:
        (copy / INDEX_FILE).write_text("{")
    with pytest.raises(DataError, match=r"cannot be read.*\nRemove the folder"):
        opened(copy, data_folder, source)


def test_a_crash_leaves_no_store(
    data_folder: Path, trajectories: list[TrajectoryFrames], source: SlotSource, tmp_path: Path
) -> None:
    calls = []

    def dies(rgb: Tensor) -> Tensor:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return known_slots(rgb)

    with pytest.raises(KeyboardInterrupt):
        extract(tmp_path, data_folder, trajectories, source, dies)
    assert list(tmp_path.iterdir()) == []


def test_slots_that_are_not_numbers_are_refused(
    data_folder: Path, trajectories: list[TrajectoryFrames], source: SlotSource, tmp_path: Path
) -> None:
    with pytest.raises(NonFiniteError, match=r"slots of .*000000.h5 are not finite"):
        extract(tmp_path, data_folder, trajectories, source, lambda rgb: known_slots(rgb) / 0.0)


def test_other_processes_wait_for_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    index, pauses = tmp_path / INDEX_FILE, []

    def pause(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 3:
            index.touch()

    monkeypatch.setattr("time.sleep", pause)
    wait_for_slots(index)
    assert len(pauses) == 3 and min(pauses) > 0


class KnownSystem(nn.Module):
    """Counts what it is asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.scale, self.frozen = nn.Linear(1, 1), nn.Dropout(0.5)
        self.frozen.eval()
        self.frames = 0

    def encode_views(self, rgb: Tensor) -> Tensor:
        assert not self.training and rgb.dtype == torch.uint8
        self.frames += rgb.shape[0] * rgb.shape[1]
        return known_slots(rgb)


def test_a_system_is_as_it_was_after_encoding() -> None:
    system = KnownSystem()
    with encoder_of(system) as encode:
        encode(torch.zeros(2, 1, 4, 4, 3, dtype=torch.uint8))
    assert system.training and system.scale.training and not system.frozen.training
    assert system.scale.weight.device.type == "cpu"


def views_data(folder: Path, **changes: Any) -> ViewDataModule:
    settings = compose("train", ["data=views", f"data.folder={folder}", "run.folder=any"])["data"]
    settings.pop("_target_")
    settings.update(
        batch_size=2, num_workers=0, resolution=RESOLUTION, num_history=3, num_steps=2, num_validation_clips=0
    )
    return ViewDataModule(**{**settings, **changes})


def test_batches_hold_the_slots_of_their_own_frames(data_folder: Path, tmp_path: Path) -> None:
    checkpoint = tmp_path / "first.ckpt"
    checkpoint.write_bytes(b"weights")
    module, system = views_data(data_folder), KnownSystem()
    module.prepare(system, tmp_path / "run", checkpoint)
    assert system.frames == 3 * VIEWS * FRAMES

    assert module.slots is not None
    for batch in module.loader(max_steps=5):
        assert batch.images.shape[1] == batch.slots.shape[1] == 5 and batch.num_history == 3
        assert batch.rgbs.shape[1] == 2
        for name, slots in zip(batch.clips, batch.slots, strict=True):
            file, view, start = name.replace("@", "#").split("#")
            path = load_manifest(data_folder).folder / file
            whole = module.slots.read(path, int(view), range(FRAMES))
            assert torch.equal(slots, whole[int(start) : int(start) + 5])
    there = list(views_data_like(module, num_workers=2).loader(max_steps=2))
    for a, b in zip(module.loader(max_steps=2), there, strict=True):
        assert torch.equal(a.slots, b.slots)


def views_data_like(module: ViewDataModule, **changes: Any) -> ViewDataModule:
    other = views_data(module.folder, **changes)
    other.slots = module.slots
    return other


def test_slots_are_made_once_for_a_checkpoint_and_refused_for_another(data_folder: Path, tmp_path: Path) -> None:
    checkpoint, run, system = tmp_path / "first.ckpt", tmp_path / "run", KnownSystem()
    checkpoint.write_bytes(b"weights")
    views_data(data_folder).prepare(system, run, checkpoint)
    assert sorted(path.name for path in (run / FOLDER).iterdir()) == [INDEX_FILE, ARRAY_FILE]
    frames = system.frames

    views_data(data_folder).prepare(system, run, checkpoint)  # a resumed run
    assert system.frames == frames
    checkpoint.write_bytes(b"other weights")
    with pytest.raises(CheckpointError, match="another checkpoint"):
        views_data(data_folder).prepare(system, run, checkpoint)


def test_a_shared_folder_serves_other_runs_but_not_more_videos(data_folder: Path, tmp_path: Path) -> None:
    checkpoint, shared, system = tmp_path / "first.ckpt", str(tmp_path / "shared"), KnownSystem()
    checkpoint.write_bytes(b"weights")
    views_data(data_folder, slot_folder=shared, num_trajectories=2).prepare(system, tmp_path / "a", checkpoint)
    views_data(data_folder, slot_folder=shared, num_trajectories=1).prepare(system, tmp_path / "b", checkpoint)
    assert system.frames == 2 * VIEWS * FRAMES
    assert not (tmp_path / "a").exists() and not (tmp_path / "b").exists()
    with pytest.raises(DataError, match="no slots of train/000002.h5, camera 0: they were made for fewer videos"):
        views_data(data_folder, slot_folder=shared).prepare(system, tmp_path / "c", checkpoint)
