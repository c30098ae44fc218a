"""A robot in a ROS bag: tf says where its links are, its model what they look like. Metres."""

import numpy as np
import pytest

from data_gen.importers.ros_bag import recordings
from data_gen.importers.ros_mapping import read_ros_mapping
from data_gen.importers.settings import ImportSettings
from tests.data_gen.importers.moving_camera import pose
from vpd_lightning.errors import ConfigError, DataError

pytest.importorskip("rosbags")
from tests.data_gen.importers.bag_writer import START, BagWriter  # noqa: E402
from tests.data_gen.importers.ros_scene import (  # noqa: E402
    DEPTH,
    NUM_FRAMES,
    RGB,
    TIMES,
    film,
    write_images,
    write_transforms,
)

ARM = """
<mujoco><worldbody><body name="base"><geom type="box" size="0.05 0.05 0.02"/>
  <body name="tip" pos="0 0 0.1"><joint name="turn" type="hinge"/><geom type="sphere" size="0.03"/></body>
</body></worldbody></mujoco>"""
TEXT = f"cameras: [{{rgb: {RGB}, depth: {DEPTH}}}]\nrobot: {{model: arm.xml, points: 40, frames: {{base: arm_base}}}}"
BASE = np.array([[0.0, -1, 0, 0.4], [1, 0, 0, 0.1], [0, 0, 1, 0.05], [0, 0, 0, 1]])


def tip_at(time: float) -> np.ndarray:
    """In the map: it goes along x at a tenth of a metre a second."""
    moved = np.eye(4)
    moved[:3, 3] = [0.1 * time, 0.2, 0.3]
    return moved


def write(folder, last=0.5, base="arm_base"):
    (folder / "arm.xml").write_text(ARM)
    (folder / "mapping.yaml").write_text(TEXT)
    with BagWriter(folder, "ros2") as bag:
        write_transforms(bag)
        bag.transform("/tf_static", START, "map", base, BASE)
        for time in np.arange(-0.04, last, 0.01):
            bag.transform("/tf", START + 50_000_000 + round(time * 1e9), "map", "tip", tip_at(time))
        write_images(bag, film())
    return bag.path, ImportSettings(mapping=str(folder / "mapping.yaml"))


def test_links_are_where_tf_says_at_the_time_of_each_image(tmp_path):
    (recording,) = recordings(*write(tmp_path))
    driven = recording.driven
    assert driven is not None and driven.points.shape[0] == NUM_FRAMES
    np.testing.assert_allclose(driven.poses[:, 0], np.broadcast_to(BASE, (NUM_FRAMES, 4, 4)), atol=1e-12)
    np.testing.assert_allclose(driven.poses[:, 1], [tip_at(time) for time in TIMES], atol=1e-6)
    for frame, time in enumerate(TIMES):
        tip = driven.points[frame, driven.groups == 1]
        np.testing.assert_allclose(np.linalg.norm(tip - tip_at(time)[:3, 3], axis=1), 0.03, atol=1e-3)
    np.testing.assert_allclose(recording.cam_to_world[:, 0], [pose(time) for time in TIMES], atol=1e-6)


def test_frames_without_the_robot_are_left_out(tmp_path):
    (recording,) = recordings(*write(tmp_path, last=TIMES[-1] - 0.02))
    assert recording.num_frames == NUM_FRAMES - 1
    assert recording.driven is not None and len(recording.driven.points) == NUM_FRAMES - 1


def test_a_link_that_tf_does_not_know_is_named_with_the_frames_there_are(tmp_path):
    with pytest.raises(DataError, match=r"no frame 'arm_base' for the robot's link 'base'") as error:
        list(recordings(*write(tmp_path, base="elsewhere")))
    assert "elsewhere" in str(error.value) and "robot: frames: {base: FRAME}" in str(error.value)


@pytest.mark.parametrize(
    ("robot", "words"),
    [
        ("3", "'model' with the path"),
        ("{model: arm.xml, frame: {}}", "unknown key 'frame'"),
        ("{model: arm.xml, points: 0}", "points is 0"),
        ("{model: arm.xml, frames: [tip]}", "LINK: FRAME"),
        ("{model: arm.xml, frames: {tp: tip}}", "no link 'tp' with a shape"),
        ("{model: leg.xml}", "there is no such file"),
    ],
)
def test_wrong_entries_are_named(tmp_path, robot, words):
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "mapping.yaml").write_text(f"cameras: []\nrobot: {robot}")
    with pytest.raises(ConfigError, match=words):
        read_ros_mapping(tmp_path / "mapping.yaml")
