"""A robot's motion comes with a plain recording, in the data set's world, and mistakes in it are named."""

import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_gen.importers.conventions import world_rotation
from data_gen.importers.plain_action import ACTION_FILE, read_action
from data_gen.importers.run import import_recordings
from tests.data_gen.importers.checks import attributes, files
from tests.data_gen.importers.plain_recording import write_plain
from vpd_lightning.data.driven import read_driven
from vpd_lightning.errors import DataError

NUM_FRAMES = 8
GROUPS = np.array([0, 0, 1, 1, 1])


def links() -> dict[str, np.ndarray]:
    """Two links with five points, each of which turns and moves in its own way."""
    draw = np.random.default_rng(0)
    normals = draw.normal(size=(5, 3))
    poses = np.tile(np.eye(4), (NUM_FRAMES, 2, 1, 1))
    poses[..., :3, :3] = Rotation.random(2 * NUM_FRAMES, rng=draw).as_matrix().reshape(NUM_FRAMES, 2, 3, 3)
    poses[..., :3, 3] = draw.normal(size=(NUM_FRAMES, 2, 3))
    return {
        "link_points": draw.normal(size=(5, 3)),
        "link_normals": normals / np.linalg.norm(normals, axis=1, keepdims=True),
        "groups": GROUPS,
        "poses": poses,
        "commanded_poses": poses[::-1],
    }


def moved() -> dict[str, np.ndarray]:
    """The same, as points that moved: one by one."""
    given = links()
    points, normals = np.empty((NUM_FRAMES, 5, 3)), np.empty((NUM_FRAMES, 5, 3))
    for time, particle in np.ndindex(NUM_FRAMES, 5):
        pose = given["poses"][time, GROUPS[particle]]
        points[time, particle] = (pose @ [*given["link_points"][particle], 1])[:3]
        normals[time, particle] = pose[:3, :3] @ given["link_normals"][particle]
    return {"points": points, "normals": normals, "groups": GROUPS, "poses": given["poses"]}


@pytest.mark.parametrize("arrays", [links(), moved()], ids=["links", "points"])
def test_motion_is_cut_turned_scaled_and_moved_with_the_pictures(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    source = write_plain(tmp_path / "take", num_frames=NUM_FRAMES)
    np.savez(source / ACTION_FILE, **arrays)
    settings = {"every": 2, "clip_frames": 4, "up": "y", "scale": 2.0, "recenter": True}
    (path,) = files(import_recordings(source, tmp_path / "out", settings))
    found = read_driven(path)
    assert found is not None and found.poses is not None
    shift = np.asarray(attributes(path)["source_shift"])
    turn = world_rotation("y")[:3, :3]
    truth = moved()
    np.testing.assert_allclose(found.points, 2 * truth["points"][::2] @ turn.T + shift, atol=1e-5)
    np.testing.assert_allclose(found.normals, truth["normals"][::2] @ turn.T, atol=1e-6)
    np.testing.assert_array_equal(found.groups, GROUPS)
    np.testing.assert_allclose(found.poses[..., :3, :3], turn @ truth["poses"][::2, :, :3, :3], atol=1e-12)
    # A point of a link stays where its pose brings it, in the new world, too.
    carried = found.poses[:, 0, :3, :3] @ (2 * links()["link_points"][0]) + found.poses[:, 0, :3, 3]
    np.testing.assert_allclose(found.points[:, 0], carried, atol=1e-5)
    assert (found.commanded_poses is not None) == ("commanded_poses" in arrays)


def test_a_recording_without_a_robot_has_none(tmp_path: Path) -> None:
    (path,) = files(import_recordings(write_plain(tmp_path / "take"), tmp_path / "out"))
    assert read_driven(path) is None


def _without(name: str) -> Callable[[dict[str, Any]], None]:
    return lambda arrays: arrays.pop(name)


def _with(name: str, change: Callable[[np.ndarray], Any]) -> Callable[[dict[str, Any]], None]:
    return lambda arrays: arrays.update({name: change(arrays[name])})


@pytest.mark.parametrize(
    ("arrays", "change", "message"),
    [
        (links, _without("poses"), "needs either points and normals, or link_points, link_normals and poses"),
        (moved, _without("normals"), "needs either points and normals"),
        (moved, lambda arrays: arrays.update(joints=np.zeros(3)), "holds joints; known: points"),
        (links, lambda arrays: arrays.update(points=moved()["points"]), "needs either"),
        (moved, _with("points", lambda values: values[:-1]), "a row for every frame"),
        (moved, _with("normals", lambda values: 3 * values), "not of unit length"),
        (links, _with("link_points", lambda values: values[:-1]), "do not fit each other"),
        (links, _with("groups", lambda values: values + 5), "groups are numbers of links"),
        (moved, _with("groups", lambda values: 2 * values), "without gaps"),
        (moved, _with("groups", lambda values: values.astype(float)), "groups is float64"),
        (links, _with("poses", lambda values: values[..., :3, :]), "do not fit each other"),
        (links, _with("commanded_poses", lambda values: values[:, :1]), "commanded_poses has shape"),
        (moved, _with("points", lambda values: values.astype(str)), "numbers are needed"),
        (moved, _with("points", lambda values: values[0]), "points has shape"),
    ],
)
def test_mistakes_are_named(
    tmp_path: Path, arrays: Callable[[], dict], change: Callable[[dict], None], message: str
) -> None:
    given = arrays()
    change(given)
    path = tmp_path / ACTION_FILE
    np.savez(path, **given)
    with pytest.raises(DataError, match=re.escape(message)) as caught:
        read_action(path, NUM_FRAMES)
    assert str(path) in str(caught.value)


def test_a_file_that_is_no_archive_is_named(tmp_path: Path) -> None:
    path = tmp_path / ACTION_FILE
    path.write_bytes(b"no archive")
    with pytest.raises(DataError, match="is no NumPy archive"):
        read_action(path, NUM_FRAMES)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("points.npy", b"no array")
    with pytest.raises(DataError, match="numbers are needed"):
        read_action(path, NUM_FRAMES)
