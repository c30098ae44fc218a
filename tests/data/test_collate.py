"""Batches of samples."""

from pathlib import Path

import pytest
import torch

from tests.data.recordings import write_recordings
from tests.training.tiny_training import tiny_data
from vpd_lightning.data.collate import collate_clips


def test_a_batch_is_its_samples_stacked(tmp_path: Path) -> None:
    data = tiny_data(write_recordings(tmp_path), batch_size=3).clip_dataset(max_steps=4)
    samples = [data[item] for item in (3, 4, 5)]
    batch = collate_clips(samples)
    assert batch.context.rgb.shape == (3, 2, 1, 16, 16, 3) and batch.context.rgb.dtype == torch.uint8
    assert batch.context.depth.shape == (3, 2, 1, 16, 16)
    assert batch.context.cameras.shape == (3, 2, 1)
    assert batch.rays.origins.shape == batch.rays.directions.shape == batch.rgbs.shape == (3, 2, 8, 3)
    assert (batch.keys.seed, batch.keys.step, list(batch.keys.sample_index)) == (0, 1, [0, 1, 2])
    assert list(batch.clips) == [sample.clip for sample in samples]
    assert torch.equal(batch.rgbs[1], samples[1].rgbs)


def test_samples_of_different_steps_do_not_mix(tmp_path: Path) -> None:
    data = tiny_data(write_recordings(tmp_path)).clip_dataset(max_steps=4)
    with pytest.raises(ValueError, match="one training step"):
        collate_clips([data[0], data[2]])
