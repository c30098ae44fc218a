import pickle
from collections.abc import Callable
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


def replace_dataset(file: h5py.File, name: str, data: np.ndarray, **options: Any) -> None:
    attributes = dict(file[name].attrs)
    del file[name]
    file.create_dataset(name, data=data, **options)
    for key, value in attributes.items():
        file[name].attrs[key] = value


def external_storage(file: h5py.File) -> None:
    shape = file["rgb"].shape
    del file["rgb"]
    file.create_dataset("rgb", shape, np.uint8, external=[("/etc/hostname", 0, int(np.prod(shape)))])


def virtual_storage(file: h5py.File) -> None:
    shape = file["depth"].shape
    layout = h5py.VirtualLayout(shape, np.float32)
    layout[:] = h5py.VirtualSource("/tmp/other.h5", "depth", shape)
    del file["depth"]
    file.create_virtual_dataset("depth", layout)


def external_link(file: h5py.File) -> None:
    del file["rgb"]
    file["rgb"] = h5py.ExternalLink("/tmp/other.h5", "/rgb")


def soft_link(file: h5py.File) -> None:
    file["shortcut"] = h5py.SoftLink("/rgb")


def unknown_filter(file: h5py.File) -> None:
    replace_dataset(file, "depth", file["depth"][...], scaleoffset=3, chunks=True)


def too_many_bytes(file: h5py.File) -> None:
    del file["rgb"]
    file.create_dataset("rgb", (10**6, 64, 4096, 4096, 3), np.uint8, chunks=(1, 1, 64, 64, 3))


def huge_chunk(file: h5py.File) -> None:
    del file["rgb"]
    file.create_dataset("rgb", (60, 3, 1024, 1024, 3), np.uint8, chunks=(40, 3, 1024, 1024, 3))


def set_matrix(name: str, change: Callable[[np.ndarray], None]) -> Callable[[h5py.File], None]:
    def apply(file: h5py.File) -> None:
        values = file[name][...]
        change(values)
        replace_dataset(file, name, values)

    return apply


def set_attribute(name: str, value: Any) -> Callable[[h5py.File], None]:
    def apply(file: h5py.File) -> None:
        file.attrs[name] = value

    return apply


def remove(name: str) -> Callable[[h5py.File], None]:
    def apply(file: h5py.File) -> None:
        del file[name]

    return apply


def mirror(poses: np.ndarray) -> None:
    poses[:, :3, 0] *= -1


def stretch(poses: np.ndarray) -> None:
    poses[:, :3, :3] *= 1.01


def transpose(poses: np.ndarray) -> None:
    poses[:] = np.swapaxes(poses, 1, 2).copy()


def not_a_number(values: np.ndarray) -> None:
    values[0, 0, 0] = np.nan


def negative_focal(values: np.ndarray) -> None:
    values[:, 0, 0] *= -1


def normalised(values: np.ndarray) -> None:
    values[:, :2] /= 16 * 32


def far_center(values: np.ndarray) -> None:
    values[:, 0, 2] = 1000


def sheared_row(values: np.ndarray) -> None:
    values[:, 1, 0] = 1


FAULTS: dict[str, tuple[Callable[[h5py.File], None], str]] = {
    "external storage": (external_storage, "external storage"),
    "virtual data set": (virtual_storage, "virtual data set"),
    "external link": (external_link, "external link"),
    "soft link": (soft_link, "soft link"),
    "unknown filter": (unknown_filter, "unknown filter"),
    "too many bytes": (too_many_bytes, "more than the allowed"),
    "huge chunk": (huge_chunk, "chunks of"),
    "no rgb": (remove("rgb"), "has no data set 'rgb'"),
    "group for data set": (lambda f: (f.pop("rgb"), f.create_group("rgb"))[1] and None, "not a data set"),
    "float16 depth": (lambda f: replace_dataset(f, "depth", f["depth"][...].astype(np.float16)), "dtype float16"),
    "float rgb": (lambda f: replace_dataset(f, "rgb", f["rgb"][...].astype(np.float32)), "dtype float32"),
    "four channels": (lambda f: replace_dataset(f, "rgb", np.zeros((6, 3, 16, 16, 4), np.uint8)), "4 channels"),
    "depth of other size": (lambda f: replace_dataset(f, "depth", np.ones((6, 3, 8, 8), np.float32)), "has shape"),
    "no frames": (lambda f: replace_dataset(f, "rgb", np.zeros((0, 3, 16, 16, 3), np.uint8)), "non-empty"),
    "left-handed": (set_matrix("cam_to_world", mirror), "left-handed"),
    "not orthonormal": (set_matrix("cam_to_world", stretch), "not orthonormal"),
    "transposed pose": (set_matrix("cam_to_world", transpose), "row 0 0 0 1"),
    "pose nan": (set_matrix("cam_to_world", not_a_number), "'cam_to_world' is not finite"),
    "poses of other views": (lambda f: replace_dataset(f, "cam_to_world", np.tile(np.eye(4), (7, 1, 1))), "has shape"),
    "intrinsics nan": (set_matrix("intrinsics", not_a_number), "'intrinsics' is not finite"),
    "negative focal": (set_matrix("intrinsics", negative_focal), "focal lengths"),
    "normalised intrinsics": (set_matrix("intrinsics", normalised), "are they in pixels"),
    "far principal point": (set_matrix("intrinsics", far_center), "principal point"),
    "intrinsics no matrix": (set_matrix("intrinsics", sheared_row), "is not \\[\\[fx"),
    "newer schema": (set_attribute("schema_version", 99), "schema version 99"),
    "ray depth": (set_attribute("depth_type", "ray"), "depth_type 'ray'"),
    "near behind far": (set_attribute("near", 9.0), "near < far"),
    "no time": (set_attribute("frame_time", 0.0), "frame_time"),
    "text for a number": (set_attribute("far", "five"), "attribute 'far'"),
    "far nan": (set_attribute("far", np.nan), "not finite"),
    "empty workspace": (set_attribute("workspace_max", np.array([-2.0, 1, 1])), "empty workspace"),
    "flat workspace": (set_attribute("workspace_max", 1.0), "3 numbers"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_files_are_refused_by_name(path: Path, fault: str):
    break_it, message = FAULTS[fault]
    with h5py.File(path, "r+") as file:
        break_it(file)

    with pytest.raises(DataError, match=message) as caught:
        TrajectoryReader(path).rgb([0])

    assert str(path) in str(caught.value)
    assert 2 <= len(str(caught.value).splitlines()) <= 5
    assert caught.value.exit_code == 3


def test_missing_truncated_and_other_files_are_told_apart(path: Path, tmp_path: Path):
    cut, text = tmp_path / "cut.h5", tmp_path / "text.h5"
    cut.write_bytes(path.read_bytes()[:-2000])
    text.write_text("hello")

    for name, message in {"none.h5": "no such file", "cut.h5": "truncated", "text.h5": "not an HDF5 file"}.items():
        with pytest.raises(DataError, match=f"{name}: .*{message}"):
            TrajectoryReader(tmp_path / name).num_frames  # noqa: B018


def test_flipped_byte_in_the_pixels_is_noticed(path: Path):
    with h5py.File(path) as file:
        chunk = file["rgb"].id.get_chunk_info(4)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset + chunk.size // 2] ^= 0xFF
    path.write_bytes(content)

    with pytest.raises(DataError, match="bytes are damaged"):
        TrajectoryReader(path).rgb()


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
