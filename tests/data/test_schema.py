from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.data.recordings import make_trajectory
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.schema import decode_depth, encode_depth, write_trajectory
from vpd_lightning.files import AtomicPath


def test_what_is_written_is_read_back(tmp_path: Path):
    trajectory = make_trajectory(3)
    write_trajectory(tmp_path / "a.h5", trajectory)

    with TrajectoryReader(tmp_path / "a.h5") as reader:
        intrinsics, cam_to_world = reader.cameras()
        np.testing.assert_array_equal(reader.rgb(), trajectory.rgb)
        np.testing.assert_array_equal(reader.depth(), trajectory.depth)
        np.testing.assert_array_equal(intrinsics[2], trajectory.intrinsics)
        np.testing.assert_array_equal(cam_to_world[-1], trajectory.cam_to_world)
        assert (reader.num_frames, reader.num_views, reader.height, reader.width) == trajectory.depth.shape
        assert reader.frame_time == trajectory.frame_time
        assert (reader.near, reader.far) == (trajectory.near, trajectory.far)
        assert reader.workspace_min == trajectory.workspace_min
        assert reader.workspace_max == trajectory.workspace_max


@pytest.mark.parametrize("compression", ["lzf", "gzip", "none"])
def test_every_compression_is_readable(tmp_path: Path, compression: str):
    trajectory = make_trajectory(1)
    write_trajectory(tmp_path / "a.h5", trajectory, compression=compression)

    np.testing.assert_array_equal(TrajectoryReader(tmp_path / "a.h5").rgb(), trajectory.rgb)


def test_images_are_chunked_by_view_and_checksummed(tmp_path: Path):
    write_trajectory(tmp_path / "a.h5", make_trajectory(1))

    with h5py.File(tmp_path / "a.h5") as file:
        for name in ("rgb", "depth"):
            assert file[name].chunks == (1, 1, *file[name].shape[2:])
            assert file[name].fletcher32
            assert file[name].compression == "gzip"  # whose bytes depend on the pictures alone


def test_depth_as_uint16_errs_by_at_most_half_a_step(tmp_path: Path):
    depth = np.random.default_rng(0).uniform(0.3, 5.0, (2, 1, 8, 8)).astype(np.float32)
    depth[0, 0, :2] = 0.0
    codes, scale, offset = encode_depth(depth)
    decoded = decode_depth(codes, scale, offset)

    assert scale < 4.7 / 65000
    np.testing.assert_array_equal(decoded == 0, depth == 0)
    assert np.abs(decoded - depth).max() <= 0.5 * scale + 1e-6  # float32 rounding at 5 m is below 1e-6


def test_depth_as_uint16_is_decoded_by_the_reader(tmp_path: Path):
    trajectory = make_trajectory(1)
    write_trajectory(tmp_path / "a.h5", trajectory, depth_encoding="uint16")

    np.testing.assert_allclose(TrajectoryReader(tmp_path / "a.h5").depth(), trajectory.depth, atol=1e-5)


def test_depth_without_any_measurement_survives_uint16():
    codes, scale, offset = encode_depth(np.zeros((1, 1, 4, 4), np.float32))

    assert not decode_depth(codes, scale, offset).any()


def test_same_content_gives_same_bytes(tmp_path: Path):
    for name in ("a.h5", "b.h5"):
        write_trajectory(tmp_path / name, make_trajectory(1))

    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_wrong_dtype_or_shape_is_refused_before_writing():
    trajectory = make_trajectory(1)

    with pytest.raises(ValueError, match="rgb is float32"):
        replace(trajectory, rgb=trajectory.rgb.astype(np.float32))
    with pytest.raises(ValueError, match="cam_to_world"):
        replace(trajectory, cam_to_world=trajectory.cam_to_world[:1])


@pytest.mark.parametrize("option", [{"compression": "zip"}, {"depth_encoding": "float16"}])
def test_unknown_storage_options_are_refused(tmp_path: Path, option: dict[str, str]):
    with pytest.raises(ValueError, match="allowed"):
        write_trajectory(tmp_path / "a.h5", make_trajectory(1), **option)
    assert not list(tmp_path.iterdir())


def test_failed_writing_leaves_the_old_file_and_no_rest(tmp_path: Path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    with pytest.raises(KeyboardInterrupt), AtomicPath(path) as partial:
        partial.write_text("half")
        raise KeyboardInterrupt

    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
