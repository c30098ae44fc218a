"""Clips carry the given motion of the frames that they are made of, in training, validation and evaluation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.data.recordings import make_trajectory, write_dataset_file
from tests.training.tiny_training import tiny_data
from vpd_lightning.data.clip import read_clip, read_motion
from vpd_lightning.data.collate import collate_clips
from vpd_lightning.data.driven_motion import DrivenMotion
from vpd_lightning.data.schema import write_trajectory
from vpd_lightning.training.callbacks.memory_estimate import first_clip

NUM_FRAMES = 8


def motion(num_points: int) -> DrivenMotion:
    """Points whose x is ten times the frame plus their number, so that each place says what it is."""
    points = np.zeros((NUM_FRAMES, num_points, 3), np.float32)
    points[..., 0] = 10 * np.arange(NUM_FRAMES)[:, None] + np.arange(num_points)
    normals = np.broadcast_to(np.array([0, 0, 1], np.float32), points.shape).copy()
    return DrivenMotion(points, normals, np.zeros(num_points, np.int32))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of which the second has more points, and the third none."""
    folder = tmp_path_factory.mktemp("data")
    splits: dict[str, list[Path]] = {"train": [], "validation": []}
    for index, (split, count) in enumerate([("train", 3), ("train", 5), ("train", 0), ("validation", 4)]):
        path = folder / split / f"{index:06d}.h5"
        path.parent.mkdir(exist_ok=True)
        action = motion(count).as_arrays() if count else None
        write_trajectory(path, replace(make_trajectory(index, num_frames=NUM_FRAMES), action=action))
        splits[split].append(path)
    write_dataset_file(folder, splits)
    return folder


def test_a_training_clip_has_the_motion_of_its_frames(folder: Path) -> None:
    clips = tiny_data(folder, load_driven=True).clip_dataset(max_steps=20)
    seen = set()
    for item in range(20):
        sample = clips[item]
        name, start = sample.clip.split("@")
        number = int(Path(name).stem)
        seen.add(number)
        if number == 2:
            assert sample.driven is None
            continue
        assert sample.driven is not None
        expected = 10.0 * (int(start) + np.arange(len(sample.driven.positions)))
        np.testing.assert_array_equal(sample.driven.positions[:, 0, 0].numpy(), expected)
        assert len(sample.driven.positions) == 2 + sample.rgbs.shape[0]
    assert seen == {0, 1, 2}


def test_a_batch_pads_motions_of_fewer_points(folder: Path) -> None:
    clips = tiny_data(folder, load_driven=True, num_steps_schedule=None).clip_dataset(max_steps=20)
    by_count = {sample.clip.split("@")[0][-9:-3]: sample for sample in map(clips.__getitem__, range(20))}
    samples = [replace(by_count[name], step=0) for name in ("000000", "000001", "000002")]
    batch = collate_clips(samples)
    assert batch.driven is not None and batch.context.driven is not None
    assert batch.driven.mask[:, 0].sum(dim=-1).tolist() == [3, 5, 0]
    assert batch.driven.positions.shape[:3] == (3, 3, 5) and batch.context.driven.positions.shape[:3] == (3, 2, 5)
    steps = torch.cat([batch.context.driven.positions, batch.driven.positions], dim=1)[1, :, 0, 0]
    assert torch.equal(steps.diff(), torch.full((4,), 10.0)), "the steps follow the context"
    one = first_clip(batch, num_steps=5)
    assert one.driven is not None and one.driven.mask.shape == (1, 5, 5)
    none = collate_clips([replace(sample, driven=None) for sample in samples])
    assert none.driven is None and none.context.driven is None


def test_without_the_setting_nothing_is_loaded(folder: Path) -> None:
    data = tiny_data(folder)
    assert all(data.clip_dataset(max_steps=4)[item].driven is None for item in range(4))


@pytest.mark.parametrize("load_driven", [True, False])
def test_validation_clips_have_it_at_context_and_target(folder: Path, load_driven: bool) -> None:
    data = tiny_data(folder, load_driven=load_driven, num_validation_clips=1)
    data.setup()
    assert data.validation is not None
    clip = data.validation[0]
    if not load_driven:
        assert clip.context.driven is None and clip.target.driven is None
        return
    places = torch.cat([clip.context.driven.positions, clip.target.driven.positions])[:, 0, 0]
    assert torch.equal(places.diff(), torch.full((3,), 10.0))


def test_an_evaluated_clip_and_what_comes_after_the_recording(folder: Path) -> None:
    path = folder / "validation" / "000003.h5"
    clip = read_clip(path, 0, start=1, num_steps=3, with_state=False)
    assert clip.context_driven is not None and clip.target_driven is not None
    assert clip.context_driven.positions[:, 0, 0].tolist() == [10, 20]
    assert clip.target_driven.positions[:, 0, 0].tolist() == [30, 40, 50]
    later = read_motion(path, 5, 5)
    assert later is not None and later.positions[:, 0, 0].tolist() == [50, 60, 70, 70, 70]
    assert read_motion(folder / "train" / "000002.h5", 5, 5) is None
