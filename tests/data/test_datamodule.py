"""The data of a training: loaders, ranks, resuming, validation clips, backgrounds, and what is refused."""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.data.recordings import make_trajectory, write_dataset_file, write_recordings
from tests.training.tiny_training import tiny_data, tiny_module, tiny_trainer
from vpd_lightning.data.background import median_images
from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.data.sampler import StepBatchSampler
from vpd_lightning.data.schema import write_trajectory
from vpd_lightning.errors import ConfigError, DataError
from vpd_lightning.types import VideoBatch


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("data"))


def assert_same(a: VideoBatch, b: VideoBatch) -> None:
    assert (a.keys, list(a.clips)) == (b.keys, list(b.clips))
    assert torch.equal(a.context.rgb, b.context.rgb) and torch.equal(a.context.depth, b.context.depth)
    assert torch.equal(a.rays.directions, b.rays.directions) and torch.equal(a.rgbs, b.rgbs)


@pytest.mark.parametrize("cache", [False, True])
def test_loader_workers_change_nothing(folder: Path, cache: bool) -> None:
    here = list(tiny_data(folder, cache=cache).loader(max_steps=6))
    there = list(tiny_data(folder, cache=cache, num_workers=2).loader(max_steps=6))
    assert len(here) == len(there) == 6
    for a, b in zip(here, there, strict=True):
        assert_same(a, b)


def test_ranks_share_out_the_batch_of_one_rank(folder: Path) -> None:
    whole = list(tiny_data(folder, batch_size=4).loader(max_steps=3))
    shares = [list(tiny_data(folder, batch_size=4).loader(3, rank=rank, world_size=2)) for rank in range(2)]
    for step, batch in enumerate(whole):
        parts = [share[step] for share in shares]
        assert torch.equal(batch.rgbs, torch.cat([part.rgbs for part in parts]))
        assert [index for part in parts for index in part.keys.sample_index] == [0, 1, 2, 3]


def test_a_resumed_loader_goes_on_where_it_stopped(folder: Path) -> None:
    whole = list(tiny_data(folder).loader(max_steps=6))
    rest = list(tiny_data(folder).loader(max_steps=6, first_step=lambda: 4))
    assert len(rest) == 2
    for a, b in zip(whole[4:], rest, strict=True):
        assert_same(a, b)


def test_a_batch_that_does_not_divide_by_the_devices_is_refused() -> None:
    with pytest.raises(ConfigError, match="must divide by their number, which is 2"):
        StepBatchSampler(batch_size=3, max_steps=1, rank=0, world_size=2, first_step=lambda: 0)


def test_a_subset_of_the_training_trajectories(folder: Path) -> None:
    data = tiny_data(folder, num_trajectories=1)
    clips = {clip.split("@")[0] for batch in data.loader(max_steps=10) for clip in batch.clips}
    assert clips == {"train/000000.h5"}


@pytest.mark.parametrize("count", [0, 5])
def test_more_trajectories_than_there_are_is_refused(folder: Path, count: int) -> None:
    with pytest.raises(DataError, match=f"num_trajectories={count}, but .* has 4 training trajectories"):
        tiny_data(folder, num_trajectories=count).setup()


def test_a_missing_folder_is_answered_with_the_command_that_makes_it(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="vpd-data generate"):
        tiny_data(tmp_path / "nothing").setup()


def test_no_input_view_is_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="input_views must name at least one view"):
        tiny_data(folder, input_views=[])


def test_validation_clips_are_fixed_and_from_the_validation_split(folder: Path) -> None:
    clips = []
    for seed in (0, 1):
        data = tiny_data(folder, num_validation_clips=4, seed=seed)
        data.setup()
        clips.append(list(data.val_dataloader()))
    names = [clip.name for clip in clips[0]]
    assert names == [clip.name for clip in clips[1]]
    assert len(set(names)) == 4 and all(name.startswith("validation/") for name in names)
    first = clips[0][0]
    assert first.context.rgb.shape == (2, 1, 16, 16, 3)
    assert first.target.rgb.shape == (2, 1, 16, 16, 3) and first.target.cameras.shape == (2, 1)


def test_the_background_is_the_median_of_the_training_images(folder: Path) -> None:
    data = tiny_data(folder, input_views=[1])
    rgb, depth, cameras = data.median_background()
    assert rgb.shape == (1, 16, 16, 3) and rgb.dtype == torch.uint8
    floor = np.random.default_rng(0).integers(60, 90, size=(2, 16, 16, 3))[1]
    np.testing.assert_array_equal(rgb[0].numpy(), floor)
    assert (depth == 1.5).all()
    assert cameras.shape == (1,) and cameras.cam_to_world[0, 0, 3] == pytest.approx(0.1)


def test_the_median_of_a_view_is_taken_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[int]] = []

    def counted(trajectories: Sequence[TrajectoryFrames], views: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        asked.append(list(views))
        return median_images(trajectories, views)

    monkeypatch.setattr("vpd_lightning.data.datamodule.median_images", counted)
    data = tiny_data(folder, input_views=[1], target_views=[1, 0], moving_ray_fraction=0.5)
    background = data.median_background()
    data.clip_dataset(max_steps=1)
    data.clip_dataset(max_steps=1)
    assert asked == [[1], [0]]
    rgb, depth, _ = data.median_background([1, 0, 1])
    expected_rgb, expected_depth = median_images(data.trajectories, [1, 0, 1])
    assert np.array_equal(rgb.numpy(), expected_rgb) and np.array_equal(depth.numpy(), expected_depth)
    assert torch.equal(background[0], rgb[:1])


def test_pixels_without_a_measurement_do_not_count_as_background_depth(tmp_path: Path) -> None:
    trajectory = make_trajectory(0)
    trajectory.depth[:5, :, 0, 0] = 0.0
    trajectory.depth[:, :, 0, 1] = 0.0
    path = tmp_path / "train" / "000000.h5"
    write_trajectory(path, trajectory)
    write_dataset_file(tmp_path, {"train": [path], "validation": [], "test": []})
    _, depth, _ = tiny_data(tmp_path, num_validation_clips=0).median_background()
    assert depth[0, 0, 0] in (1.5, pytest.approx(1.3)) and depth[0, 0, 1] == 0.0


def test_a_background_of_cameras_that_differ_is_refused(tmp_path: Path) -> None:
    paths = [tmp_path / "train" / f"{index:06d}.h5" for index in range(2)]
    for index, path in enumerate(paths):
        write_trajectory(path, make_trajectory(index, shift=0.2 * index))
    write_dataset_file(tmp_path, {"train": paths, "validation": [], "test": []})
    with pytest.raises(DataError, match="cameras move, or differ"):
        tiny_data(tmp_path, num_validation_clips=0).median_background()


@pytest.mark.parametrize(
    ("change", "message"),
    [({"max_steps": -1, "max_epochs": 1}, "counted in steps"), ({"accumulate_grad_batches": 2}, "must be 1")],
)
def test_trainers_that_would_count_steps_differently_are_refused(
    folder: Path, tmp_path: Path, change: dict[str, int], message: str
) -> None:
    trainer = tiny_trainer(tmp_path, steps=2, **change)
    with pytest.raises(ConfigError, match=message):
        trainer.fit(tiny_module(), tiny_data(folder))


def test_a_loader_without_a_trainer_starts_at_the_first_step(folder: Path) -> None:
    batches = list(islice(tiny_data(folder).loader(max_steps=2), 2))
    assert [batch.keys.step for batch in batches] == [0, 1]
