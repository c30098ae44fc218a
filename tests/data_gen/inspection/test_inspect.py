from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from data_gen.inspection.camera_plot import frustum
from data_gen.inspection.inspect import describe, draw_contact_sheet, inspect_dataset
from data_gen.inspection.point_cloud import merged_points, splat
from tests.data.analytic_scene import known_trajectory
from tests.data.recordings import write_dataset_file, write_recordings
from tests.data_gen.blocks import generate_small
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.schema import write_trajectory


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate_small(tmp_path_factory.mktemp("blocks") / "small", **{"camera.num_views": 4})


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
    folder = write_recordings(tmp_path / "data")
    sheet = draw_contact_sheet(folder, None if target is None else tmp_path / target)
    image = cv2.imread(str(sheet))

    assert sheet.suffix == ".png" and image is not None
    assert image.shape[1] > 3 * 96 and image.std() > 10  # two views and one depth
    assert not list(sheet.parent.glob(".*"))


def test_everything_is_drawn_beside_the_sheet(blocks: Path, tmp_path: Path):
    files = inspect_dataset(blocks, tmp_path / "out")

    names = ["contact_sheet.png", "trajectories.png", "cameras.png", "points.ply", "points.png"]
    assert [file.relative_to(tmp_path / "out").as_posix() for file in files] == names
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(names)
    for file in files:
        if file.suffix == ".png":
            assert cv2.imread(str(file)).std() > 10


def test_one_moving_camera_is_drawn(tmp_path: Path):
    write_trajectory(tmp_path / "a.h5", known_trajectory(num_views=1, num_frames=4, is_moving=True))
    files = inspect_dataset(tmp_path / "a.h5", tmp_path / "sheet.png")

    assert [file.name for file in files] == ["sheet.png", "cameras.png", "points.ply", "points.png"]


def test_recording_without_depth_is_drawn(tmp_path: Path):
    trajectory = known_trajectory()
    write_trajectory(tmp_path / "a.h5", replace(trajectory, depth=np.zeros_like(trajectory.depth)))

    assert all(file.is_file() for file in inspect_dataset(tmp_path / "a.h5"))


def test_trajectories_of_different_sizes_are_drawn(tmp_path: Path):
    paths = [tmp_path / "train" / f"{index}.h5" for index in range(2)]
    for path, height in zip(paths, (48, 24), strict=True):
        write_trajectory(path, known_trajectory(height=height))
    write_dataset_file(tmp_path, {"train": paths})

    assert all(file.is_file() for file in inspect_dataset(tmp_path))


def test_merged_points_lie_on_the_known_surfaces(tmp_path: Path):
    """Without boxes a point is on the floor or on the wall; float32 depth at 4 m is good to a micrometre."""
    wall = 1.5
    trajectory = known_trajectory(seed=3, workspace_min=(-99.0, -99.0, -1.0), workspace_max=(99.0, 99.0, 9.0))
    write_trajectory(tmp_path / "a.h5", trajectory)
    with TrajectoryReader(tmp_path / "a.h5") as reader:
        positions, colors = merged_points(reader)

    assert len(positions) == len(colors) == (trajectory.depth[0] > 0).sum()
    assert positions[:, 2].min() > -1e-5 and positions[:, 1].max() < wall + 1e-5
    is_box = (positions[:, 2] > 1e-5) & (positions[:, 1] < wall - 1e-5)
    assert np.abs(positions[is_box, :2]).max() < 0.5 + 0.3 * np.sqrt(2)  # centres within 0.5, half sizes up to 0.3


def test_points_outside_the_workspace_are_left_out(tmp_path: Path):
    write_trajectory(tmp_path / "a.h5", known_trajectory(seed=3))
    with TrajectoryReader(tmp_path / "a.h5") as reader:
        positions, _ = merged_points(reader)
        assert ((positions >= reader.workspace_min) & (positions <= reader.workspace_max)).all()


def test_nearer_point_hides_the_farther_one():
    positions = np.array([[0.0, 0, 1], [0, 0, 0], [1, 1, 0]])
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    picture, (left, right, bottom, top) = splat(positions, colors, azimuth=-90, elevation=90)

    row = int((top - 0.0) / (top - bottom) * len(picture))
    column = int((0.0 - left) / (right - left) * len(picture))
    assert picture[row, column].tolist() == [255, 0, 0]
    assert (picture == [0, 0, 255]).all(axis=-1).any() and not (picture == [0, 255, 0]).all(axis=-1).any()


def test_frustum_spans_the_field_of_view():
    """Focal length equal to half the side: 90 degrees, so that the corners are as far aside as ahead."""
    corners = frustum(np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]]), np.eye(4), 16, 16, length=2.0)

    np.testing.assert_allclose(corners, [[-2, -2, 2], [2, -2, 2], [2, 2, 2], [-2, 2, 2]])
