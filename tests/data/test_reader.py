import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.data.recordings import make_trajectory
from vpd_lightning.data.ground_truth import has_state, read_state
from vpd_lightning.data.reader import ReaderCache, TrajectoryReader
from vpd_lightning.data.schema import write_trajectory
from vpd_lightning.errors import DataError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_trajectory(tmp_path / "good.h5", make_trajectory(5, num_frames=6, num_views=3))
    return tmp_path / "good.h5"


@pytest.mark.parametrize("times", [[0], [1, 2, 3], [5, 0, 3], [2, 2], np.array([4, 5]), []])
@pytest.mark.parametrize("views", [[0], [2, 0], [0, 1, 2], range(1, 3)])
def test_any_choice_of_frames_and_views_equals_indexing_the_whole(path: Path, times: Any, views: Any):
    reader = TrajectoryReader(path)
    grid = np.ix_(np.asarray(times, int), np.asarray(views, int))

    np.testing.assert_array_equal(reader.rgb(times, views), reader.rgb()[grid])
    np.testing.assert_array_equal(reader.depth(times, views), reader.depth()[grid])
    for part, whole in zip(reader.cameras(times, views), reader.cameras(), strict=True):
        np.testing.assert_array_equal(part, whole[grid])


@pytest.mark.parametrize("ask", [{"times": [6]}, {"views": [3]}, {"times": [-1]}])
def test_asking_for_more_than_there_is_names_file_and_range(path: Path, ask: dict[str, list[int]]):
    with pytest.raises(DataError, match=r"good.h5: (frame 6|view 3|frame -1) was asked for; it has \d"):
        TrajectoryReader(path).rgb(**ask)


def test_unmeasured_depth_reads_as_zero(tmp_path: Path):
    trajectory = make_trajectory(1)
    trajectory.depth[0, 0, 0, :3] = [np.nan, np.inf, 0.0]
    write_trajectory(tmp_path / "a.h5", trajectory)

    depth = TrajectoryReader(tmp_path / "a.h5").depth([0], [0])
    assert not depth[0, 0, 0, :3].any()


def test_views_have_the_names_of_the_source_where_it_has_some(path: Path, tmp_path: Path):
    with TrajectoryReader(path) as reader:
        assert (reader.view_names, reader.view_label(1)) == ((), "1")
    named = make_trajectory(5, num_views=3)
    write_trajectory(
        tmp_path / "named.h5", replace(named, attributes={"view_names": '["left", "the\\nmiddle", "right"]'})
    )
    with TrajectoryReader(tmp_path / "named.h5") as reader:
        assert reader.view_names == ("left", "the middle", "right")
        assert reader.view_label(2) == "2 (right)"


def test_moving_cameras_are_read_per_frame(tmp_path: Path):
    trajectory = make_trajectory(1, num_frames=4)
    poses = np.repeat(trajectory.cam_to_world[None], 4, axis=0)
    poses[:, :, 0, 3] += np.arange(4)[:, None]
    write_trajectory(tmp_path / "a.h5", replace(trajectory, cam_to_world=poses))
    reader = TrajectoryReader(tmp_path / "a.h5")

    assert not reader.is_static_cameras
    np.testing.assert_array_equal(reader.cameras([3], [1])[1][0, 0], poses[3, 1])


def test_open_reader_can_be_sent_to_another_process(path: Path):
    reader = TrajectoryReader(path)
    expected = reader.rgb([0])

    np.testing.assert_array_equal(pickle.loads(pickle.dumps(reader)).rgb([0]), expected)


def test_reader_gives_no_way_to_the_state():
    assert not [name for name in vars(TrajectoryReader) if "state" in name.strip("_") and not name.startswith("__")]


def test_cache_keeps_the_last_used_and_closes_the_rest(tmp_path: Path):
    paths = [tmp_path / f"{index}.h5" for index in range(3)]
    for index, path in enumerate(paths):
        write_trajectory(path, make_trajectory(index))
    cache = ReaderCache(capacity=2)
    first, second = cache.get(paths[0]), cache.get(paths[1])
    first.rgb([0]), second.rgb([0])

    assert cache.get(paths[0]) is first
    cache.get(paths[2])
    assert cache.get(paths[0]) is first
    assert cache.get(paths[1]) is not second
    assert len(pickle.loads(pickle.dumps(cache))._readers) == 0
    with pytest.raises(ValueError, match="at least 1"):
        ReaderCache(capacity=0)


def test_recording_without_state_says_so(path: Path):
    assert not has_state(path)
    with pytest.raises(DataError, match="no complete ground truth"):
        read_state(path)


def test_state_behind_a_link_is_refused(path: Path, tmp_path: Path):
    with h5py.File(path, "r+") as file:
        group = file.create_group("state")
        for name in ("positions", "quaternions", "linear_velocities", "angular_velocities", "half_sizes"):
            group[name] = np.zeros((6, 1, 3))
        group["segmentation"] = h5py.SoftLink("/rgb")

    with pytest.raises(DataError, match="soft link"):
        read_state(path)
