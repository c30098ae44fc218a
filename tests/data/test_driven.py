"""Given motion is read as it was written, and refused where it cannot be right."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.data.analytic_scene import known_trajectory
from vpd_lightning.data.driven import read_driven
from vpd_lightning.data.driven_motion import DrivenMotion
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.schema import write_trajectory
from vpd_lightning.errors import DataError

NUM_FRAMES, NUM_POINTS = 3, 5


def motion() -> DrivenMotion:
    draw = np.random.default_rng(0)
    normals = draw.normal(size=(NUM_FRAMES, NUM_POINTS, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    poses = np.tile(np.eye(4), (NUM_FRAMES, 2, 1, 1))
    return DrivenMotion(
        points=draw.normal(size=(NUM_FRAMES, NUM_POINTS, 3)).astype(np.float32),
        normals=normals.astype(np.float32),
        groups=np.array([0, 0, 1, 1, 1], np.int32),
        poses=poses,
        commanded_poses=poses + 0.0,
    )


def written(path: Path, action: dict[str, Any] | None) -> Path:
    write_trajectory(path, replace(known_trajectory(0, num_frames=NUM_FRAMES), action=action))
    return path


def test_it_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = written(tmp_path / "a.h5", motion().as_arrays())
    found = read_driven(path)
    assert found is not None and found.num_groups == 2
    for name, values in motion().as_arrays().items():
        np.testing.assert_array_equal(getattr(found, name), values)
    with TrajectoryReader(path) as reader:  # whoever needs no action reads the file as any other
        assert reader.num_frames == NUM_FRAMES


def test_poses_may_be_left_out(tmp_path: Path) -> None:
    action = replace(motion(), poses=None, commanded_poses=None).as_arrays()
    found = read_driven(written(tmp_path / "a.h5", action))
    assert found is not None and found.poses is None and found.commanded_poses is None


def test_a_file_without_action_is_of_the_first_version_and_has_none(tmp_path: Path) -> None:
    path = written(tmp_path / "a.h5", None)
    assert read_driven(path) is None
    with h5py.File(path) as file:
        assert file.attrs["schema_version"] == 1


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("points", lambda values: values[:-1], "a row for every frame"),
        ("points", lambda values: values.astype(np.float64), "must be float32"),
        ("points", lambda values: values * np.nan, "not finite"),
        ("normals", lambda values: values * 2, "not of unit length"),
        ("normals", lambda values: values[:, :-1], "action/normals has shape"),
        ("groups", lambda values: values * 2, "without gaps"),
        ("groups", lambda values: values[:-1], "each of the 5 points"),
        ("poses", lambda values: values[:, :1], "action/poses has shape"),
        ("commanded_poses", lambda values: values * 2, "not rotations"),
        ("normals", None, "has no data set 'normals'"),
    ],
)
def test_what_cannot_be_right_is_refused(
    tmp_path: Path, name: str, change: Callable[[np.ndarray], np.ndarray] | None, message: str
) -> None:
    action = motion().as_arrays()
    if change is None:
        del action[name]
    else:
        action[name] = change(action[name])
    path = written(tmp_path / "a.h5", action)
    with pytest.raises(DataError, match=message):
        read_driven(path)


def test_an_action_that_is_no_group_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.h5", None)
    with h5py.File(path, "a") as file:
        file["action"] = np.zeros(3)
    with pytest.raises(DataError, match="'action' is not a group"):
        read_driven(path)
