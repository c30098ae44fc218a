"""Which held-out frames are predicted: the same ones, whatever the system is shown."""

from pathlib import Path

import pytest
import torch

from tests.data.recordings import write_recordings
from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.validation import ValidationClips


def clips(folder: Path, num_context: int, num_clips: int, num_steps: int = 3) -> ValidationClips:
    paths = load_manifest(folder).split("validation")
    return ValidationClips(
        trajectories=[TrajectoryFrames(path, use_cache=False) for path in paths],
        num_clips=num_clips,
        num_context_frames=num_context,
        num_steps=num_steps,
        input_views=[0],
        target_views=[0, 1],
        start_frames=None,
    )


def first_targets(made: ValidationClips) -> list[int]:
    return [start + made.num_context_frames for _, start in made.clips]


@pytest.mark.parametrize("num_clips", [2, 5, 8])
def test_systems_that_are_shown_two_and_six_frames_predict_the_same_ones(tmp_path: Path, num_clips: int) -> None:
    folder = write_recordings(tmp_path, num_validation=2, num_frames=14)
    two, six = clips(folder, 2, num_clips), clips(folder, 6, num_clips)

    for index in range(num_clips):
        assert two[index].context.rgb.shape[0] == 2 and six[index].context.rgb.shape[0] == 6
        assert torch.equal(two[index].context.rgb, six[index].context.rgb[-2:])
        assert torch.equal(two[index].target.rgb, six[index].target.rgb)
    assert len({(trajectory.path, start) for trajectory, start in two.clips}) == num_clips
    assert min(first_targets(two)) == 6 and max(first_targets(two)) <= 14 - 3


def test_recordings_too_short_for_that_still_give_different_clips(tmp_path: Path) -> None:
    folder = write_recordings(tmp_path, num_validation=2, num_frames=9)
    assert first_targets(clips(folder, 2, 2)) == first_targets(clips(folder, 6, 2)) == [6, 6]
    assert first_targets(clips(folder, 2, 4)) == [2, 2, 4, 4]
    assert first_targets(clips(folder, 2, 2, num_steps=7)) == [2, 2]
