"""What may move in a recording, as ``vpd-data inspect`` draws it: a block above a floor, true and noisy depth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.data.recordings import make_trajectory
from vpd_lightning.data.schema import write_trajectory
from vpd_lightning.runs.moving_pixels import find_moving_pixels

SIZE = 64


def recorded(folder: Path, noise: float = 0.0, side: int = 12) -> tuple[Path, np.ndarray]:
    """Write a trajectory with a block ``side`` pixels wide; return its file and where the block is."""
    trajectory = make_trajectory(0, num_frames=5, num_views=2, size=SIZE)
    depth = np.full_like(trajectory.depth, 1.5)
    for time in range(5):
        depth[time, :, 20 : 20 + side, 10 + 4 * time : 10 + 4 * time + side] = 1.3
    is_block = depth < 1.4
    depth *= 1 + noise * np.random.default_rng(0).standard_normal(depth.shape).astype(np.float32)
    path = folder / "take.h5"
    write_trajectory(path, replace(trajectory, depth=depth))
    return path, is_block


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_the_block_is_found_and_the_floor_is_not(noise: float, tmp_path: Path) -> None:
    path, is_block = recorded(tmp_path, noise)
    found = find_moving_pixels(path)
    assert found.times == [0, 2, 4]
    assert found.noise == pytest.approx([noise, noise], rel=0.15, abs=1e-6)
    truth = is_block[found.times]
    assert (found.moving & truth).sum() / truth.sum() > 0.8
    assert (found.moving & truth).sum() / found.moving.sum() > 0.9
    assert found.in_workspace.all()


def test_a_person_is_told_the_share_the_noise_and_when_it_is_too_much(tmp_path: Path) -> None:
    lines = find_moving_pixels(recorded(tmp_path)[0]).summary()
    assert lines[0] == "depth noise    0.00 % of depth (by view 0.00, 0.00)"
    assert lines[1].startswith("may move       3.5% of the pixels") and len(lines) == 2
    (tmp_path / "noisy").mkdir()
    lines = find_moving_pixels(recorded(tmp_path / "noisy", 0.02)[0]).summary()
    assert "warning: above 0.9 % of noise" in lines[2] and "smooth=2" in lines[2]


def test_only_the_workspace_counts(tmp_path: Path) -> None:
    trajectory = make_trajectory(0, num_frames=3, num_views=1, size=SIZE)
    path = tmp_path / "take.h5"
    write_trajectory(path, replace(trajectory, workspace_min=(-0.3, -0.3, -0.1), workspace_max=(0.3, 0.3, 0.5)))
    found = find_moving_pixels(path)
    assert 0.05 < found.in_workspace.mean() < 0.5
    assert not (found.moving & ~found.in_workspace).any()
