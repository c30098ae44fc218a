import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from data_gen.inspection.free_space import free_space_violations
from data_gen.inspection.validate import MAX_RELATIVE_DISTANCE, convention_errors, validate_dataset
from tests.data.recordings import make_trajectory, write_dataset_file, write_recordings
from tests.data_gen.blocks import generate_small
from vpd_lightning.data.schema import write_trajectory

GL = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate_small(tmp_path_factory.mktemp("blocks") / "small", **{"camera.num_views": 4})


def names(folder: Path) -> list[str]:
    return [fault.name for fault in validate_dataset(folder) if fault.is_error]


def test_generated_data_have_no_faults(blocks: Path):
    assert validate_dataset(blocks) == []
    assert validate_dataset(blocks / "train" / "000000.h5") == []


def test_recordings_with_parallel_cameras_have_no_faults(tmp_path: Path):
    faults = validate_dataset(write_recordings(tmp_path))

    # Flat floor, cameras side by side: much looks the same either way, and that is said once, not per file.
    assert [(fault.name, fault.is_error) for fault in faults] == [("cannot_tell", False)]


def test_views_of_exact_data_agree_far_below_the_bound(blocks: Path):
    """Inverse depth between pixels is interpolated, so that planes agree to float32."""
    errors = convention_errors(blocks / "train" / "000000.h5")

    assert errors["as stored"] < MAX_RELATIVE_DISTANCE / 1000
    assert min(errors, key=errors.__getitem__) == "as stored"


def convert(path: Path, change: Callable[[h5py.File], None]) -> None:
    with h5py.File(path, "r+") as file:
        change(file)


def as_distance(file: h5py.File) -> None:
    height, width = file["depth"].shape[2:]
    matrix = file["intrinsics"][0]
    x = (np.arange(width) + 0.5 - matrix[0, 2]) / matrix[0, 0]
    y = (np.arange(height) + 0.5 - matrix[1, 2]) / matrix[1, 1]
    file["depth"][...] *= np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2).astype(np.float32)


def as_gl(file: h5py.File) -> None:
    file["cam_to_world"][...] = file["cam_to_world"][...] @ GL


def as_inverse(file: h5py.File) -> None:
    file["cam_to_world"][...] = np.linalg.inv(file["cam_to_world"][...])


def as_gl_distance(file: h5py.File) -> None:
    as_gl(file)
    as_distance(file)


@pytest.mark.parametrize(
    ("change", "hint"),
    [
        (as_gl, "the camera axes are OpenGL's (y up, z back)"),
        (as_inverse, "cam_to_world is world_to_cam: invert it"),
        (as_distance, "depth is the distance to the camera centre: divide"),
        (as_gl_distance, "diag(1, -1, -1, 1); and depth is the distance to the camera centre: divide"),
    ],
)
def test_wrong_conventions_are_found_and_named(
    blocks: Path, tmp_path: Path, change: Callable[[h5py.File], None], hint: str
):
    path = tmp_path / "a.h5"
    shutil.copy(blocks / "train" / "000000.h5", path)
    convert(path, change)

    disagreements = [fault for fault in validate_dataset(path) if fault.name == "views_disagree"]
    assert len(disagreements) == 1
    assert hint in disagreements[0].message


def test_changed_and_missing_files_are_told_apart(tmp_path: Path):
    folder = write_recordings(tmp_path)
    convert(folder / "train" / "000001.h5", lambda file: file.attrs.modify("seed", 99))
    found = [(fault.name, Path(fault.file).name) for fault in validate_dataset(folder) if fault.is_error]
    assert found == [("checksum", "000001.h5")]

    (folder / "train" / "000002.h5").unlink()
    assert names(folder) == ["manifest"]


def test_one_flipped_byte_is_found(tmp_path: Path):
    folder = write_recordings(tmp_path)
    path = folder / "train" / "000000.h5"
    with h5py.File(path) as file:
        chunk = file["depth"].id.get_chunk_info(3)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset + 5] ^= 1
    path.write_bytes(content)

    assert set(names(folder)) == {"damaged_data", "checksum"}


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"depth": 0.0}, "no_depth"),
        ({"depth": -1.0}, "negative_depth"),
        ({"depth": 1500.0}, "empty_workspace"),
    ],
)
def test_implausible_depths_are_named(tmp_path: Path, change: dict[str, float], name: str):
    trajectory = make_trajectory(0)
    path = tmp_path / "train" / "000000.h5"
    write_trajectory(path, replace(trajectory, depth=np.full_like(trajectory.depth, change["depth"])))
    write_dataset_file(tmp_path, {"train": [path]})

    assert name in names(tmp_path)


def test_files_of_different_shapes_are_named(tmp_path: Path):
    paths = [tmp_path / "train" / f"{index}.h5" for index in range(2)]
    for path, size in zip(paths, (16, 24), strict=True):
        write_trajectory(path, make_trajectory(0, size=size))
    write_dataset_file(tmp_path, {"train": paths})

    assert names(tmp_path) == ["mixed_shapes"]


def test_exact_views_leave_the_space_before_surfaces_free(blocks: Path):
    found = free_space_violations(blocks / "train" / "000000.h5")

    assert found.share < 0.01 and found.num_points > 1000
    assert len(found.pairs) == 12  # four views, each with each
    assert found.noise < 1e-6


def test_share_of_points_in_free_space_is_counted(tmp_path: Path):
    """Cameras of one place see a wall at 2 m; one of them has a ninth of its pixels (two of 18 columns) at 1.5 m."""
    trajectory = make_trajectory(0, num_frames=1, size=18)
    poses, depth = trajectory.cam_to_world, np.full_like(trajectory.depth, 2.0)
    poses[1] = poses[0]
    depth[0, 1, :, 5:7] = 1.5
    write_trajectory(tmp_path / "a.h5", replace(trajectory, depth=depth, cam_to_world=poses))
    found = free_space_violations(tmp_path / "a.h5")

    assert found.num_points == 2 * 16 * 16  # the border has no nine pixels
    assert found.pairs == {(0, 1): 0.0, (1, 0): pytest.approx(2 / 16)}
    assert found.share == found.share_beyond_noise == pytest.approx(1 / 16)
    faults = [fault for fault in validate_dataset(tmp_path / "a.h5") if fault.is_error]
    assert [fault.name for fault in faults] == ["free_space"]
    assert "points of view 1 seen from view 0" in faults[0].message


def test_nine_pixels_must_be_measured_and_half_a_per_cent_is_allowed(tmp_path: Path):
    trajectory = make_trajectory(0, num_frames=1)  # the workspace is 2 m wide: 1 cm is allowed
    poses = trajectory.cam_to_world
    poses[1] = poses[0]
    for height, share in ((0.009, 0.0), (0.011, 1.0)):
        depth = np.full_like(trajectory.depth, 2.0)
        depth[0, 1] -= height
        depth[0, 0, 8, 8] = 0
        path = tmp_path / f"{height}.h5"
        write_trajectory(path, replace(trajectory, depth=depth, cam_to_world=poses))
        found = free_space_violations(path)

        assert found.pairs == {(0, 1): 0.0, (1, 0): share}
        assert found.num_points == (14 * 14 - 1) + (14 * 14 - 9)


def test_noise_of_the_depth_explains_points_in_front(tmp_path: Path):
    trajectory = make_trajectory(0, num_frames=1, size=48)
    poses = trajectory.cam_to_world
    poses[1] = poses[0]
    noise = np.random.default_rng(0).standard_normal(trajectory.depth.shape)
    depth = (2 + 0.04 * noise).astype(np.float32)
    write_trajectory(tmp_path / "a.h5", replace(trajectory, depth=depth, cam_to_world=poses))
    found = free_space_violations(tmp_path / "a.h5")

    assert found.noise == pytest.approx(0.02, rel=0.1)
    assert found.share > 0.01 > found.share_beyond_noise
    faults = [fault for fault in validate_dataset(tmp_path / "a.h5") if fault.name == "free_space"]
    assert not faults[0].is_error and "noise" in faults[0].message


def test_single_view_has_no_free_space_to_compare(tmp_path: Path):
    write_trajectory(tmp_path / "a.h5", make_trajectory(0, num_views=1))

    assert free_space_violations(tmp_path / "a.h5").num_points == 0


def test_state_of_another_length_is_named(blocks: Path, tmp_path: Path):
    path = tmp_path / "a.h5"
    shutil.copy(blocks / "train" / "000000.h5", path)
    with h5py.File(path, "r+") as file:
        del file["state/positions"]
        file["state/positions"] = np.zeros((3, 1, 3))

    assert "state_length" in names(path)


@pytest.mark.parametrize(
    ("name", "value", "fault"),
    [("positions", np.nan, "state_not_finite"), ("quaternions", 0.0, "state_quaternions")],
)
def test_ground_truth_that_cannot_be_is_named(blocks: Path, tmp_path: Path, name: str, value: float, fault: str):
    path = shutil.copy(blocks / "train" / "000000.h5", tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        file[f"state/{name}"][1] = value

    assert names(Path(path)) == [fault]
