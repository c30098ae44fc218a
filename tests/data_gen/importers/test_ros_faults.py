import sys

import numpy as np
import pytest

from data_gen.importers.ros_bag import recordings
from data_gen.importers.ros_file import Bag
from data_gen.importers.ros_images import depth_image
from data_gen.importers.ros_transforms import TransformTree
from data_gen.importers.settings import ImportSettings
from tests.data_gen.importers.moving_camera import FOCAL, HEIGHT, WIDTH, pose, quaternion_wxyz
from vpd_lightning.errors import ConfigError, DataError

pytest.importorskip("rosbags")
from tests.data_gen.importers.bag_writer import START, BagWriter  # noqa: E402
from tests.data_gen.importers.ros_scene import (  # noqa: E402
    DEPTH,
    DEPTH_INFO,
    INFO,
    OPTICAL,
    RGB,
    STAMPS,
    film,
    make_bag,
    millimetres,
    write_images,
    write_transforms,
)


@pytest.fixture(scope="module")
def pictures():
    return film()


def test_no_calibration_is_named(tmp_path, pictures):
    path = make_bag(tmp_path, pictures, model="missing")
    with pytest.raises(DataError, match=f"calibration of {RGB} is missing: no CameraInfo on {INFO}"):
        list(recordings(path, ImportSettings()))


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"model": "equidistant", "distortion": (0.1, 0.0, 0.0, 0.0)}, "lens model 'equidistant' with 4 numbers"),
        ({"size": (HEIGHT * 2, WIDTH * 2)}, "calibration is for 128 x 96 pixels"),
        ({"focal": 0.0}, "not calibrated"),
    ],
)
def test_unusable_calibrations_are_named(tmp_path, pictures, info, message):
    path = make_bag(tmp_path, pictures, **info)
    with pytest.raises(DataError, match=message):
        list(recordings(path, ImportSettings()))


def test_missing_transforms_are_named(tmp_path, pictures):
    with BagWriter(tmp_path, "ros1") as bag:
        write_images(bag, pictures)
    with pytest.raises(DataError, match=f"tf does not know {OPTICAL}.*pose is missing") as caught:
        list(recordings(bag.path, ImportSettings()))
    assert "cam_to_world" in str(caught.value)


def test_a_broken_tree_is_named(tmp_path, pictures):
    with BagWriter(tmp_path, "ros2") as bag:
        write_transforms(bag, connect=False)
        write_images(bag, pictures)
    file = tmp_path / "cameras.yaml"
    file.write_text(f"world_frame: map\ncameras:\n  - rgb: {RGB}\n    depth: {DEPTH}\n")
    with pytest.raises(DataError, match=f"tf does not connect {OPTICAL} with map"):
        list(recordings(bag.path, ImportSettings(mapping=str(file))))


def test_transforms_of_another_time_are_named(tmp_path, pictures):
    with BagWriter(tmp_path, "ros2") as bag:
        write_transforms(bag, start=5.0, stop=6.0)
        write_images(bag, pictures)
    with pytest.raises(DataError, match="5 have all other images within 0.02 s and 0 all poses"):
        list(recordings(bag.path, ImportSettings()))


def test_unaligned_depth_is_refused(tmp_path, pictures):
    path = make_bag(tmp_path, pictures, depth_frame="camera_depth_optical_frame")
    with pytest.raises(DataError, match="depth is not aligned to colour.*different frames") as caught:
        list(recordings(path, ImportSettings()))
    assert "align_depth" in str(caught.value)
    file = tmp_path / "cameras.yaml"
    file.write_text(f"cameras:\n  - rgb: {RGB}\n    depth: {DEPTH}\n    is_aligned: true\n")
    assert len(list(recordings(path, ImportSettings(mapping=str(file))))) == 1

    with BagWriter(tmp_path, "ros1", "sizes") as bag:
        write_transforms(bag)
        for stamp, picture in zip(STAMPS, pictures, strict=True):
            bag.image(RGB, stamp, OPTICAL, "rgb8", picture.rgb)
            bag.image(DEPTH, stamp, OPTICAL, "16UC1", millimetres(picture)[::2, ::2])
            bag.info(INFO, stamp, OPTICAL)
    with pytest.raises(DataError, match="differ in size"):
        list(recordings(bag.path, ImportSettings()))

    with BagWriter(tmp_path, "ros1", "calibrations") as bag:
        write_transforms(bag)
        write_images(bag, pictures)
        bag.info(DEPTH_INFO, STAMPS[0], OPTICAL, focal=FOCAL * 0.7)
    with pytest.raises(DataError, match="another calibration than"):
        list(recordings(bag.path, ImportSettings()))


def test_an_index_that_counts_messages_that_are_not_there_is_named(tmp_path, pictures, monkeypatch):
    path = make_bag(tmp_path, pictures)
    monkeypatch.setattr(Bag, "scan", lambda bag, topics, start=None: iter(()))

    with pytest.raises(DataError, match="its index counts messages on .*, and there are none"):
        list(recordings(path, ImportSettings()))


def test_a_bag_without_depth_lists_what_it_has(tmp_path, pictures):
    with BagWriter(tmp_path, "ros1") as bag:
        bag.image(RGB, STAMPS[0], OPTICAL, "rgb8", pictures[0].rgb)
    with pytest.raises(DataError, match=rf"has no depth images(.|\n)*{RGB} \(rgb8, 64 x 48"):
        list(recordings(bag.path, ImportSettings()))


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
def test_a_cut_off_bag_is_named(tmp_path, pictures, kind):
    path = make_bag(tmp_path, pictures, kind)
    file = path if path.is_file() else next(inner for inner in path.iterdir() if inner.suffix in (".db3", ".mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(DataError, match="made"):
        for recording in recordings(path, ImportSettings()):
            recording.read_rgb(recording.num_frames - 1, 0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cameras:\n  - rbg: /a\n    depth: /b\n", "unknown key 'rbg'; did you mean 'rgb'"),
        ("cameras:\n  - rgb: /a\n", "depth is None"),
        ("cameras: /a\n", "a list of rgb and depth topics"),
        ("cameras:\n  - rgb: /a\n    depth: /b\n    depth_scale: -1\n", "depth_scale is -1"),
        ("worldframe: map\n", "did you mean 'world_frame'"),
        ("{", "cannot be read as YAML"),
    ],
)
def test_mistakes_in_the_mapping_are_named(tmp_path, pictures, text, message):
    path = make_bag(tmp_path, pictures)
    file = tmp_path / "cameras.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message):
        list(recordings(path, ImportSettings(mapping=str(file))))


def test_unknown_topics_in_the_mapping_are_named(tmp_path, pictures):
    path = make_bag(tmp_path, pictures)
    file = tmp_path / "cameras.yaml"
    file.write_text("cameras:\n  - rgb: /left/image\n    depth: /left/depth\n")
    with pytest.raises(DataError, match=f"no images on /left/image(.|\n)*{DEPTH}"):
        list(recordings(path, ImportSettings(mapping=str(file))))


def test_without_rosbags_the_error_says_what_to_install(tmp_path, pictures, monkeypatch):
    path = make_bag(tmp_path, pictures)
    for name in [name for name in sys.modules if name.split(".")[0] == "rosbags"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match=r'pip install "vpd-lightning\[ros\]"'):
        list(recordings(path, ImportSettings()))


def test_unmeasured_floating_point_depth_becomes_zero(tmp_path):
    values = np.array([[np.nan, np.inf, -1.0, 0.0, 2.5]], np.float32)
    with BagWriter(tmp_path, "ros2") as bag:
        message = bag.make(
            "sensor_msgs/msg/Image",
            header=bag.header(START, "x"),
            height=1,
            width=5,
            encoding="32FC1",
            is_bigendian=0,
            step=20,
            data=values.view(np.uint8).ravel(),
        )
        assert depth_image(message, 0.001, 1.0, "here").tolist() == [[0, 0, 0, 0, 2.5]]
        message.encoding = "8UC1"
        with pytest.raises(DataError, match="here: depth encoding '8UC1' is not supported"):
            depth_image(message, 0.001, 1.0, "here")


def test_poses_between_branches_of_the_tree():
    tree = TransformTree()
    turned = pose(0.3)
    tree.add("root", "world", 0, (1, 2, 3), (0, 0, 1, 0), is_static=True)
    tree.add("root", "arm", 0, turned[:3, 3], np.roll(quaternion_wxyz(turned), -1), is_static=True)
    times = np.array([0])
    world_in_root = np.array([[-1.0, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    poses, known = tree.poses("arm", "world", times, 0)
    np.testing.assert_allclose(poses[0], np.linalg.inv(world_in_root) @ turned, atol=1e-12)
    assert known.all()
    with pytest.raises(DataError, match="arm has two parents"):
        tree.add("world", "arm", 0, (0, 0, 0), (0, 0, 0, 1), is_static=True)
    tree.add("arm", "root", 0, (0, 0, 0), (0, 0, 0, 1), is_static=True)
    with pytest.raises(DataError, match="run in a circle"):
        tree.poses("arm", "world", times, 0)
    with pytest.raises(DataError, match="no unit quaternion"):
        tree.add("arm", "hand", 0, (0, 0, 0), (0, 0, 0, 0), is_static=True)
