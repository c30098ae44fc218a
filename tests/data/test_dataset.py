"""Training clips: what they hold, and that they depend on (seed, step, sample index) alone."""

import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.data.recordings import make_trajectory, write_recordings
from vpd_lightning.data.background import median_images
from vpd_lightning.data.collate import ClipSample
from vpd_lightning.data.dataset import ClipDataset, MovingRays, require_clips
from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.data.rollout_lengths import RolloutLengths
from vpd_lightning.data.schema import write_trajectory
from vpd_lightning.errors import DataError
from vpd_lightning.geometry.cameras import project
from vpd_lightning.types import Cameras


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return sorted((write_recordings(tmp_path_factory.mktemp("data")) / "train").glob("*.h5"))


def frames(files: Sequence[Path], use_cache: bool = False) -> list[TrajectoryFrames]:
    return [TrajectoryFrames(path, use_cache) for path in files]


def dataset(trajectories: Sequence[TrajectoryFrames], **changes: Any) -> ClipDataset:
    settings: dict[str, Any] = {
        "trajectories": trajectories,
        "seed": 3,
        "batch_size": 4,
        "max_steps": 20,
        "num_steps": 3,
        "num_steps_schedule": None,
        "rays_per_step": 32,
        "input_views": [1, 0],
        "target_views": [0, 1],
        "start_frames": None,
        "moving_rays": None,
        "load_future": False,
    }
    return ClipDataset(**{**settings, **changes})


def moving_rays(
    trajectories: Sequence[TrajectoryFrames], fraction: float, threshold: float = 0.1, margin: int = 0
) -> MovingRays:
    rgb, depth = median_images(trajectories, [0, 1])
    return MovingRays(
        fraction=fraction, margin=margin, color_threshold=threshold, depth_threshold=threshold, rgb=rgb, depth=depth
    )


def start_of(sample: ClipSample) -> tuple[str, int]:
    name, start = sample.clip.split("@")
    return Path(name).name, int(start)


def assert_same(a: ClipSample, b: ClipSample) -> None:
    for name in ("rgb", "depth", "intrinsics", "cam_to_world", "origins", "directions", "rgbs"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name
    assert (a.clip, a.step, a.sample_index) == (b.clip, b.step, b.sample_index)


def test_context_is_two_consecutive_frames_of_the_input_views_in_order(files: list[Path]) -> None:
    trajectories = frames(files)
    by_name = {item.path.name: item for item in trajectories}
    for item in range(12):
        sample = dataset(trajectories)[item]
        name, start = start_of(sample)
        np.testing.assert_array_equal(sample.rgb.numpy(), by_name[name].rgb([start, start + 1], [1, 0]))
        np.testing.assert_array_equal(sample.depth.numpy(), by_name[name].depth([start, start + 1], [1, 0]))
        np.testing.assert_allclose(sample.cam_to_world.numpy(), by_name[name].cameras([start, start + 1], [1, 0])[1])


@pytest.mark.parametrize("fraction", [0.0, 0.5])
def test_targets_are_the_colors_seen_along_their_rays_in_the_frames_after_the_context(
    files: list[Path], fraction: float
) -> None:
    trajectories = frames(files)
    by_name = {item.path.name: item for item in trajectories}
    data = dataset(trajectories, moving_rays=moving_rays(trajectories, fraction))
    for item in range(8):
        sample = data[item]
        name, start = start_of(sample)
        trajectory = by_name[name]
        for step in range(3):
            time = start + 2 + step
            images = trajectory.rgb([time], [0, 1])[0]
            intrinsics, poses = (torch.from_numpy(part[0]).float() for part in trajectory.cameras([time], [0, 1]))
            for origin, direction, rgb in zip(
                sample.origins[step], sample.directions[step], sample.rgbs[step], strict=True
            ):
                view = int((poses[:, :3, 3] - origin).norm(dim=-1).argmin())  # the views differ by their centres
                camera = Cameras(intrinsics[view], poses[view], trajectory.height, trajectory.width)
                pixel, _ = project((origin + 2.0 * direction)[None], camera)
                x, y = pixel[0].tolist()
                # float32 coordinates of a 16-pixel image: far less than a pixel of error
                assert abs(x % 1 - 0.5) < 1e-3 and abs(y % 1 - 0.5) < 1e-3
                np.testing.assert_allclose(rgb.numpy(), images[view, int(y), int(x)] / 255.0, atol=1e-6)


def test_directions_have_unit_length(files: list[Path]) -> None:
    lengths = dataset(frames(files))[0].directions.norm(dim=-1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths))


def test_a_sample_depends_on_its_index_alone(files: list[Path]) -> None:
    first, second = dataset(frames(files)), dataset(frames(files))
    samples = [first[item] for item in range(10)]
    for item in reversed(range(10)):
        assert_same(second[item], samples[item])
    assert len({(sample.clip, float(sample.rgbs.sum())) for sample in samples}) == 10


def test_another_seed_gives_other_samples(files: list[Path]) -> None:
    a, b = dataset(frames(files)), dataset(frames(files), seed=4)
    assert any(not torch.equal(a[item].rgbs, b[item].rgbs) for item in range(3))


@pytest.mark.parametrize("fraction", [0.0, 0.5])
def test_keeping_frames_in_memory_changes_nothing(files: list[Path], fraction: float) -> None:
    plain, cached = frames(files), frames(files, use_cache=True)
    rays = moving_rays(plain, fraction)
    a, b = dataset(plain, moving_rays=rays), dataset(cached, moving_rays=rays)
    for item in [0, 5, 9, 5, 0]:
        assert_same(a[item], b[item])


def test_every_start_frame_that_leaves_room_is_used_and_no_other(files: list[Path]) -> None:
    data = dataset(frames(files), max_steps=100)
    assert {start_of(data[item])[1] for item in range(200)} == {0, 1, 2, 3}  # 8 frames - 2 - 3 steps


def test_given_start_frames_are_the_only_ones(files: list[Path]) -> None:
    data = dataset(frames(files), start_frames=[0, 2], max_steps=100)
    assert {start_of(data[item])[1] for item in range(60)} == {0, 2}


def test_half_of_the_rays_go_to_moving_pixels(files: list[Path]) -> None:
    trajectories = frames(files)
    data = dataset(trajectories, moving_rays=moving_rays(trajectories, 0.5))
    red = torch.stack([data[item].rgbs[..., 0] > 0.9 for item in range(20)])
    assert red[..., :16].all()  # the first half of each frame's rays; the square's red is 250
    assert 0.0 < red[..., 16:].float().mean() < 0.2  # uniform: the square covers 3.5 %


@pytest.mark.parametrize("margin", [0, 1, 3])
def test_pixels_within_the_margin_of_what_moves_count_as_moving(margin: int) -> None:
    still, depth = np.zeros((2, 12, 10, 3), np.uint8), np.ones((2, 12, 10), np.float32)
    rgb = still.copy()
    rgb[1, 5, 9] = 200  # at the image border of the second view
    rays = MovingRays(fraction=0.5, margin=margin, color_threshold=0.1, depth_threshold=0.1, rgb=still, depth=depth)

    view, y, x = np.unravel_index(rays.find(rgb, depth), depth.shape)

    expected = {(5 + down, 9 - left) for down in range(-margin, margin + 1) for left in range(margin + 1)}
    assert set(view) == {1} and set(zip(y, x, strict=True)) == expected


def test_rays_are_uniform_where_nothing_moves(files: list[Path]) -> None:
    trajectories = frames(files)
    blind = dataset(trajectories, moving_rays=moving_rays(trajectories, 0.5, threshold=10.0))
    assert torch.equal(blind[0].rgbs[0], dataset(trajectories)[0].rgbs[0])  # later frames draw from another place


def test_images_without_a_ray_are_not_read(files: list[Path]) -> None:
    class Recorded(TrajectoryFrames):
        asked: list[tuple[tuple[int, ...], tuple[int, ...]]] = []

        def rgb(self, times: Sequence[int], views: Sequence[int]) -> np.ndarray:
            self.asked.append((tuple(times), tuple(views)))
            return super().rgb(times, views)

    data = dataset([Recorded(files[0], False)], input_views=[0], rays_per_step=1, num_steps=4)
    data[0]
    assert sum(len(times) * len(views) for times, views in Recorded.asked) == 2 + 4


def test_the_rollout_length_follows_the_schedule(files: list[Path]) -> None:
    data = dataset(frames(files), num_steps_schedule={0.0: 1, 0.5: 2, 0.75: 4}, num_steps=3)
    lengths = [len(data[step * 4 + 3].rgbs) for step in range(20)]
    assert lengths == [1] * 10 + [2] * 5 + [4] * 5


def test_where_several_lengths_are_named_every_update_draws_one_for_its_whole_batch(files: list[Path]) -> None:
    schedule = {0.0: 2, 0.25: [1, 4]}
    data = dataset(frames(files), num_steps_schedule=schedule, max_steps=80)
    lengths = [{len(data[step * 4 + sample].rgbs) for sample in range(4)} for step in range(80)]
    assert lengths[:20] == [{2}] * 20
    assert set(map(frozenset, lengths[20:])) == {frozenset({1}), frozenset({4})}
    assert 15 <= lengths[20:].count({4}) <= 45
    again = dataset(frames(files), num_steps_schedule=schedule, max_steps=80)
    assert [{len(again[step * 4].rgbs)} for step in range(80)] == lengths


def test_the_longest_length_that_may_be_drawn_must_fit(files: list[Path]) -> None:
    with pytest.raises(DataError, match="8 frames, but a clip needs 9"):
        dataset(frames(files), num_steps=2, num_steps_schedule={0.0: [1, 7]})


def test_without_a_schedule_the_length_is_constant() -> None:
    lengths = RolloutLengths(6, None)
    assert lengths.longest == lengths.at(0.9, 0, 3) == 6


@pytest.mark.parametrize("schedule", [{0.5: 2}, {0.0: 0}, {0.0: 2, 1.5: 3}, {0.0: [1, 0]}, {0.0: []}])
def test_schedules_that_make_no_sense_are_refused(files: list[Path], schedule: dict[float, Any]) -> None:
    with pytest.raises(ValueError, match="num_steps_schedule"):
        dataset(frames(files), num_steps_schedule=schedule)


@pytest.mark.parametrize("name", ["batch_size", "max_steps", "num_steps", "rays_per_step"])
def test_counts_below_one_are_refused(files: list[Path], name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
        dataset(frames(files), **{name: 0})


def test_trajectories_that_are_too_short_are_refused(files: list[Path]) -> None:
    with pytest.raises(DataError, match="8 frames, but a clip needs 9"):
        dataset(frames(files), num_steps=7)
    with pytest.raises(DataError, match="a clip needs 9"):
        dataset(frames(files), num_steps=3, start_frames=[0, 4])
    with pytest.raises(DataError, match="a clip needs 9"):
        dataset(frames(files), num_steps=2, num_steps_schedule={0.0: 2, 0.9: 7})


def test_views_that_are_not_there_are_refused(files: list[Path]) -> None:
    with pytest.raises(DataError, match=r"has 2 views \(0 to 1\), but view 5 is asked for"):
        dataset(frames(files), target_views=[0, 5])


def test_images_of_different_sizes_are_refused(files: list[Path], tmp_path: Path) -> None:
    odd = tmp_path / "odd.h5"
    write_trajectory(odd, make_trajectory(9, size=20))
    with pytest.raises(DataError, match="images are 20x20, but those of 000000.h5 are 16x16"):
        dataset(frames([*files, odd]))


def test_an_empty_split_is_refused() -> None:
    with pytest.raises(DataError, match="no trajectory"):
        require_clips([], 1, [0], None)


def test_a_dataset_that_was_sent_to_another_process_gives_the_same_samples(files: list[Path]) -> None:
    data = dataset(frames(files))
    expected = data[3]
    assert_same(pickle.loads(pickle.dumps(data))[3], expected)  # open files stay behind
