"""Clips of single views: what they hold, and that an epoch shows each of them once, in an order of its own."""

import pickle
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.data.recordings import make_trajectory, write_recordings
from vpd_lightning.config import compose
from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.data.schema import write_trajectory
from vpd_lightning.data.views.view_clips import ViewClipDataset, collate_views
from vpd_lightning.data.views.view_datamodule import ViewDataModule
from vpd_lightning.errors import ConfigError, DataError
from vpd_lightning.types import ViewBatch


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("data"))  # 4 trajectories, 2 views, 8 frames of 16x16 pixels


@pytest.fixture(scope="module")
def trajectories(folder: Path) -> list[TrajectoryFrames]:
    return [TrajectoryFrames(path, use_cache=False) for path in sorted((folder / "train").glob("*.h5"))]


def clips(trajectories: list[TrajectoryFrames], **changes: Any) -> ViewClipDataset:
    settings: dict[str, Any] = {
        "trajectories": trajectories,
        "seed": 3,
        "batch_size": 4,
        "max_steps": 40,
        "num_history": 5,
        "num_steps": 0,
        "num_steps_schedule": None,
        "frame_offset": 1,
        "views": [0, 1],
        "start_frames": None,
        "resolution": 8,
        "cache": False,
        "slots": None,
    }
    return ViewClipDataset(**{**settings, **changes})


def data(folder: Path, **changes: Any) -> ViewDataModule:
    settings = compose("train", ["data=views", f"data.folder={folder}", "run.folder=any"])["data"]
    settings.pop("_target_")
    settings.update(batch_size=2, num_workers=0, resolution=8, use_slots=False, num_history=4, num_steps=2)
    settings.update(num_validation_clips=2, num_validation_steps=2, validation_views=[1, 0], input_views=[0])
    return ViewDataModule(**{**settings, **changes})


def test_a_clip_is_consecutive_frames_of_one_view_at_the_resolution(trajectories: list[TrajectoryFrames]) -> None:
    dataset = clips(trajectories)
    for item in range(16):
        place, sample = dataset.place(*divmod(item, 4)), dataset[item]
        full = trajectories[place.trajectory].rgb(range(place.start, place.start + 5), [place.view])[:, 0]
        halved = full.reshape(5, 8, 2, 8, 2, 3).astype(np.float64).mean(axis=(2, 4))
        assert sample.images.dtype == torch.uint8
        assert np.abs(sample.images.numpy() - halved).max() <= 0.5  # rounded to bytes
        name = trajectories[place.trajectory].path.name
        assert sample.clip == f"train/{name}#{place.view}@{place.start}"


def test_frames_lie_the_offset_apart(trajectories: list[TrajectoryFrames]) -> None:
    dataset = clips(trajectories, num_history=3, frame_offset=3, resolution=16)
    assert dataset.num_clips == 4 * 2 * 2  # starts 0 and 1: the last frame is 6 behind
    place, sample = dataset.place(0, 1), dataset[1]
    times = [place.start, place.start + 3, place.start + 6]
    assert np.array_equal(sample.images, trajectories[place.trajectory].rgb(times, [place.view])[:, 0])


def test_an_epoch_shows_every_clip_once(trajectories: list[TrajectoryFrames]) -> None:
    dataset = clips(trajectories, batch_size=8)
    assert (dataset.num_clips, dataset.steps_per_epoch) == (4 * 2 * 4, 4)
    epochs = [[dataset.place(step, i) for step in range(4 * e, 4 * e + 4) for i in range(8)] for e in range(3)]
    for places in epochs:
        assert len(set(places)) == 32
        assert {place.start for place in places} == {0, 1, 2, 3}
        assert Counter(place.view for place in places) == {0: 16, 1: 16}
    assert epochs[0] != epochs[1] != epochs[2]


def test_clips_that_fill_no_batch_are_left_for_another_epoch(trajectories: list[TrajectoryFrames]) -> None:
    dataset = clips(trajectories, batch_size=5, max_steps=100)
    assert dataset.steps_per_epoch == 6
    assert len({dataset.place(step, i) for step in range(6) for i in range(5)}) == 30
    assert len({dataset.place(step, i) for step in range(60) for i in range(5)}) == 32


def test_fewer_clips_than_a_batch_repeat(trajectories: list[TrajectoryFrames]) -> None:
    dataset = clips(trajectories[:1], batch_size=20)
    assert dataset.num_clips == 8
    assert sorted(Counter(dataset.place(0, i) for i in range(20)).values()) == [2] * 4 + [3] * 4


@pytest.mark.parametrize(
    ("num_trajectories", "views", "frames", "num_history", "num_steps", "epochs", "steps"),
    [  # the paper's data sets; batches of 64
        (256, 16, 64, 6, 0, 40, 151_040),
        (256, 16, 64, 6, 10, 80, 250_880),
        (256, 4, 80, 6, 0, 40, 48_000),
        (256, 4, 80, 6, 10, 80, 83_200),
        (350, 9, 96, 6, 0, 40, 179_120),
        (350, 9, 96, 6, 10, 15, 59_790),
    ],
)
def test_epochs_of_the_paper_are_so_many_steps(
    num_trajectories: int, views: int, frames: int, num_history: int, num_steps: int, epochs: int, steps: int
) -> None:
    class Unread(TrajectoryFrames):
        path, num_frames, num_views, height, width, use_cache = Path("any.h5"), frames, views, 128, 128, False

        def __init__(self) -> None:
            """Of the paper's size; nothing is read."""

    dataset = clips(
        [Unread()] * num_trajectories,
        batch_size=64,
        num_history=num_history,
        num_steps=num_steps,
        views=range(views),
        resolution=128,
    )
    assert epochs * dataset.steps_per_epoch == steps


def test_a_sample_depends_on_seed_step_and_index_alone(trajectories: list[TrajectoryFrames]) -> None:
    first, second = clips(trajectories), pickle.loads(pickle.dumps(clips(trajectories)))
    for item in [0, 33, 7, 150, 33, 1]:
        a, b = first[item], second[item]
        assert torch.equal(a.images, b.images) and a.clip == b.clip
    other = clips(trajectories, seed=4)
    assert [first[item].clip for item in range(8)] != [other[item].clip for item in range(8)]


def test_keeping_frames_in_memory_changes_nothing(trajectories: list[TrajectoryFrames]) -> None:
    plain, cached = clips(trajectories), clips(trajectories, cache=True)
    for item in [0, 5, 90, 5]:
        assert torch.equal(plain[item].images, cached[item].images)


def test_start_frames_may_be_chosen(trajectories: list[TrajectoryFrames]) -> None:
    dataset = clips(trajectories, start_frames=[0, 3])
    assert dataset.num_clips == 16
    assert {dataset.place(step, 0).start for step in range(16)} == {0, 3}


def test_a_schedule_lengthens_the_rollout_and_every_clip_has_room_for_it(trajectories: list[TrajectoryFrames]) -> None:
    dataset = clips(trajectories, num_history=3, num_steps=1, num_steps_schedule={0.0: 1, 0.5: 4})
    assert dataset.num_clips == 4 * 2 * 2
    assert len(dataset[0].images) == 4 and len(dataset[20 * 4].images) == 7


def test_trajectories_of_different_lengths_count_by_their_clips(
    trajectories: list[TrajectoryFrames], tmp_path: Path
) -> None:
    write_trajectory(tmp_path / "long.h5", make_trajectory(7, num_frames=12))
    dataset = clips([trajectories[0], TrajectoryFrames(tmp_path / "long.h5", use_cache=False)], batch_size=1)
    assert dataset.num_clips == 2 * 4 + 2 * 8
    places = [dataset.place(step, 0) for step in range(24)]
    assert Counter(place.trajectory for place in places) == {0: 8, 1: 16}
    assert max(place.start for place in places if place.trajectory == 0) == 3
    assert max(place.start for place in places if place.trajectory == 1) == 7


def test_clips_that_do_not_fit_are_refused(trajectories: list[TrajectoryFrames]) -> None:
    with pytest.raises(DataError, match="8 frames, but a clip needs 9"):
        clips(trajectories, num_history=5, num_steps=4)
    with pytest.raises(DataError, match="view 2 is asked for"):
        clips(trajectories, views=[0, 2])
    for name in ("batch_size", "num_history", "frame_offset", "resolution"):
        with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
            clips(trajectories, **{name: 0})


def test_a_batch_holds_samples_of_one_step(trajectories: list[TrajectoryFrames]) -> None:
    dataset = clips(trajectories)
    batch = collate_views([dataset[8], dataset[9]], num_history=5)
    assert isinstance(batch, ViewBatch)
    assert batch.images.shape == (2, 5, 8, 8, 3) and batch.slots is None
    assert (batch.keys.seed, batch.keys.step, list(batch.keys.sample_index)) == (3, 2, [0, 1])
    assert torch.equal(batch.rgbs[1, 2], batch.images[1, 2].reshape(-1, 3) / 255.0)
    with pytest.raises(ValueError, match=r"one training step, got steps \[0, 1\]"):
        collate_views([dataset[0], dataset[4]], num_history=5)


# -- the data module -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cache", [False, True])
def test_loader_workers_change_nothing(folder: Path, cache: bool) -> None:
    here = list(data(folder, cache=cache).loader(max_steps=4))
    there = list(data(folder, cache=cache, num_workers=2).loader(max_steps=4))
    assert len(here) == len(there) == 4
    for a, b in zip(here, there, strict=True):
        assert torch.equal(a.images, b.images) and list(a.clips) == list(b.clips) and a.keys == b.keys


def test_ranks_share_out_the_batch_and_a_resumed_loader_goes_on(folder: Path) -> None:
    whole = list(data(folder, batch_size=4).loader(max_steps=3))
    shares = [list(data(folder, batch_size=4).loader(3, rank=rank, world_size=2)) for rank in range(2)]
    rest = list(data(folder, batch_size=4).loader(3, first_step=lambda: 2))
    for step, batch in enumerate(whole):
        assert torch.equal(batch.images, torch.cat([share[step].images for share in shares]))
    assert len(rest) == 1 and torch.equal(rest[0].images, whole[2].images)


def test_without_slots_a_clip_is_the_history_alone(folder: Path) -> None:
    batch = next(iter(data(folder, num_history=4, num_steps=2).loader(1)))
    assert batch.images.shape[1] == batch.num_history == 4


def test_validation_clips_continue_the_views_they_show(folder: Path) -> None:
    module = data(folder)
    module.setup()
    clip = next(iter(module.val_dataloader()))
    assert clip.context.rgb.shape == (4, 2, 16, 16, 3)  # full images: a system resizes them itself
    assert clip.target.rgb.shape == (2, 2, 16, 16, 3)
    assert torch.equal(clip.context.cameras.cam_to_world[0], clip.target.cameras.cam_to_world[0])
    held_out = TrajectoryFrames(sorted((folder / "validation").glob("*.h5"))[0], use_cache=False)
    # All systems predict from frame 6 on, however few frames they see before.
    assert np.array_equal(clip.context.rgb, held_out.rgb(range(2, 6), [1, 0]))
    assert np.array_equal(clip.target.rgb, held_out.rgb([6, 7], [1, 0]))


def test_only_the_views_that_are_wanted_are_videos(folder: Path) -> None:
    module = data(folder, target_views=[1])
    assert {clip.split("#")[1][0] for batch in module.loader(4) for clip in batch.clips} == {"1"}


def test_slots_that_nobody_made_are_refused(folder: Path, tmp_path: Path) -> None:
    module = data(folder, use_slots=True)
    with pytest.raises(ConfigError, match=r"no first training.*\n.*pretraining.ckpt"):
        module.loader(max_steps=1)
    with pytest.raises(ConfigError, match="no first training"):
        module.prepare(None, tmp_path, None)


@pytest.mark.parametrize("change", [{"num_history": 0}, {"frame_offset": 0}, {"resolution": 0}])
def test_settings_out_of_range_are_refused(folder: Path, change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="must be at least 1"):
        data(folder, **change)
