import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.data.recordings import make_trajectory, write_dataset_file, write_recordings
from tests.data_gen.blocks import generate_small
from vpd_lightning.data.inspect import describe, draw_contact_sheet
from vpd_lightning.data.schema import write_trajectory
from vpd_lightning.data.validate import MAX_RELATIVE_DISTANCE, convention_errors, validate_dataset

GL = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate_small(tmp_path_factory.mktemp("blocks") / "small", **{"camera.num_views": 4})


def names(folder: Path) -> list[str]:
    return [fault.name for fault in validate_dataset(folder)]


def test_generated_data_have_no_faults(blocks: Path):
    assert validate_dataset(blocks) == []
    assert validate_dataset(blocks / "train" / "000000.h5") == []


def test_recordings_with_parallel_cameras_have_no_faults(tmp_path: Path):
    assert validate_dataset(write_recordings(tmp_path)) == []


def test_views_of_exact_data_agree_far_below_the_bound(blocks: Path):
    """What remains is the size of a pixel: the point looked up is up to half a pixel away."""
    errors = convention_errors(blocks / "train" / "000000.h5")

    assert errors["as stored"] < MAX_RELATIVE_DISTANCE / 2
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
        (as_gl_distance, "depth is the distance to the camera centre and the axes are OpenGL's"),
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
    assert [(fault.name, Path(fault.file).name) for fault in validate_dataset(folder)] == [("checksum", "000001.h5")]

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

    assert set(names(folder)) == {"unreadable", "checksum"}


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


def test_inspection_says_what_is_there(blocks: Path):
    text = describe(blocks)

    for expected in (
        "scene mujoco_block",
        "train 2, validation 1, test 1",
        "4 frames every 0.05 s",
        "4 views of 32x24",
    ):
        assert expected in text


@pytest.mark.parametrize("target", [None, "sheets", "sheets/here.png"])
def test_contact_sheet_is_drawn(tmp_path: Path, target: Any):
    import cv2

    folder = write_recordings(tmp_path / "data")
    sheet = draw_contact_sheet(folder, None if target is None else tmp_path / target)
    image = cv2.imread(str(sheet))

    assert sheet.suffix == ".png" and image is not None
    assert image.shape[1] > 3 * 96 and image.std() > 10  # two views and one depth
    assert not list(sheet.parent.glob(".*"))
