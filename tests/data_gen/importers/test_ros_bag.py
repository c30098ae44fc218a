import sqlite3
import struct

import cv2
import h5py
import numpy as np
import pytest

from data_gen.importers.image_geometry import ImageGeometry
from data_gen.importers.ros_bag import matches, recordings
from data_gen.importers.settings import ImportSettings
from tests.data_gen.importers.known_scene import render
from tests.data_gen.importers.moving_camera import (
    FOCAL,
    HEIGHT,
    INTRINSICS,
    WIDTH,
    import_and_validate,
    largest_surface_distance,
    opengl,
    pose,
    side_pose,
)
from vpd_lightning.errors import DataError

pytest.importorskip("rosbags")
from tests.data_gen.importers.bag_writer import START, BagWriter, compressed_depth, png  # noqa: E402
from tests.data_gen.importers.ros_scene import (  # noqa: E402
    DEPTH,
    INFO,
    NUM_FRAMES,
    OPTICAL,
    RGB,
    STAMPS,
    TIMES,
    film,
    make_bag,
    millimetres,
    write_images,
    write_transforms,
)

LONGEST_RAY = float(np.sqrt(1 + (WIDTH / 2 / FOCAL) ** 2 + (HEIGHT / 2 / FOCAL) ** 2))  # per metre of depth
HALF_MILLIMETRE = 0.0005


@pytest.fixture(scope="module")
def pictures():
    return film()


@pytest.mark.parametrize(
    ("kind", "encoding", "depth_encoding"),
    [
        ("ros1", "rgb8", "16UC1"),
        ("ros1_lz4", "bgra8", "32FC1"),
        ("ros2", "bgr8", "32FC1"),
        ("mcap", "rgba8", "mono16"),
    ],
)
def test_recovers_cameras_colours_and_points(tmp_path, pictures, kind, encoding, depth_encoding):
    path = make_bag(tmp_path, pictures, kind, encoding=encoding, depth_encoding=depth_encoding)
    assert matches(path)
    (recording,) = recordings(path, ImportSettings())
    assert (recording.name, recording.num_frames, recording.num_views) == ("made", NUM_FRAMES, 1)
    assert recording.frame_time == pytest.approx(1 / 15, abs=0.006)
    np.testing.assert_allclose(recording.intrinsics, INTRINSICS[None], atol=1e-12)  # half a pixel was added
    # tf is interpolated between 100 Hz samples; the base, 0.2 m from the camera, moves on an arc: below a micrometre.
    np.testing.assert_allclose(recording.cam_to_world[:, 0], [pose(time) for time in TIMES], atol=1e-6, rtol=0)
    quantum = 1e-6 if depth_encoding == "32FC1" else HALF_MILLIMETRE
    for frame, picture in enumerate(pictures):
        np.testing.assert_array_equal(recording.read_rgb(frame, 0), picture.rgb)
        np.testing.assert_allclose(recording.read_depth(frame, 0), picture.depth, atol=quantum + 1e-6)
    assert largest_surface_distance(recording, TIMES) < quantum * LONGEST_RAY + 3e-6
    assert recording.source["axes"] == "opencv"
    assert recording.source["depth_type"] == "z"
    assert recording.source["pixel_center"] == "0.0"
    assert recording.view_names == [RGB]
    assert recording.distortion is None
    np.testing.assert_array_equal(recording.read_rgb(0, 0), pictures[0].rgb)  # back to the start


def test_reads_compressed_images(tmp_path, pictures):
    with BagWriter(tmp_path, "ros2") as bag:
        write_transforms(bag)
        for stamp, picture in zip(STAMPS, pictures, strict=True):
            form = "rgb8; png compressed bgr8"
            bag.compressed(f"{RGB}/compressed", stamp, OPTICAL, form, png(picture.rgb[..., ::-1]))
            data = struct.pack("<iff", 0, 0, 0) + png(millimetres(picture))
            bag.compressed(f"{DEPTH}/compressedDepth", stamp, OPTICAL, "16UC1; compressedDepth png", data)
            bag.info(INFO, stamp, OPTICAL)
    (recording,) = recordings(bag.path, ImportSettings())
    np.testing.assert_array_equal(recording.read_rgb(2, 0), pictures[2].rgb)
    np.testing.assert_allclose(recording.read_depth(2, 0), pictures[2].depth, atol=HALF_MILLIMETRE + 1e-6)


def test_reads_jpeg_and_inverse_depth(tmp_path, pictures):
    data, quantisation = compressed_depth(pictures[0].depth)
    with BagWriter(tmp_path, "ros1") as bag:
        write_transforms(bag)
        for stamp in STAMPS:
            _, jpeg = cv2.imencode(".jpg", pictures[0].rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])
            bag.compressed(f"{RGB}/compressed", stamp, OPTICAL, "jpeg", jpeg.tobytes())
            bag.compressed(f"{DEPTH}/compressedDepth", stamp, OPTICAL, "32FC1; compressedDepth png", data)
            bag.info(INFO, stamp, OPTICAL)
    (recording,) = recordings(bag.path, ImportSettings())
    difference = np.abs(recording.read_rgb(0, 0).astype(float) - pictures[0].rgb)
    assert np.median(difference) <= 3  # JPEG loses a little; swapped channels would differ by 50 and more
    depth = pictures[0].depth
    step = depth**2 / quantisation.a  # one step of inverse depth; the encoder rounds down
    assert (np.abs(recording.read_depth(0, 0) - depth) < step + 1e-5).all()


def test_conventions_can_be_overruled(tmp_path, pictures):
    path = make_bag(tmp_path, pictures, depth_encoding="32FC1")
    changed = ImportSettings(axes="opengl", depth="distance", pixel_center="0.5", depth_scale=0.5)
    (recording,) = recordings(path, changed)
    np.testing.assert_allclose(recording.cam_to_world[0, 0], opengl(pose(TIMES[0])), atol=1e-6)
    assert recording.intrinsics[0, 0, 2] == WIDTH / 2 - 0.5
    row, column = HEIGHT // 2, WIDTH // 2  # the ray nearest to the axis: a unit long to 1e-4
    assert recording.read_depth(0, 0)[row, column] == pytest.approx(pictures[0].depth[row, column] / 2, rel=3e-4)


def test_several_cameras_by_a_mapping(tmp_path, pictures):
    fixed = side_pose()
    late = [stamp + 6_000_000 for stamp in STAMPS]  # the second camera runs 6 ms behind the first
    seen = [render(INTRINSICS, fixed, HEIGHT, WIDTH, time + 0.006) for time in TIMES]
    with BagWriter(tmp_path, "mcap") as bag:
        write_transforms(bag)
        write_images(bag, pictures)
        for stamp, picture in zip(late, seen, strict=True):
            bag.image("/side/rgb", stamp, "side", "rgb8", picture.rgb)
            tenths = np.rint(picture.depth * 10_000).astype(np.uint16)
            bag.image("/side/depth", stamp, "side", "16UC1", tenths)
            bag.info("/side/calibration", stamp, "side", distortion=(0.01, 0.0, 0.0, 0.0, 0.0))
    file = tmp_path / "cameras.yaml"
    rows = "\n".join(f"      - {row.tolist()}" for row in fixed)
    file.write_text(
        f"world_frame: map\ncameras:\n  - rgb: {RGB}\n    depth: {DEPTH}\n"
        "  - name: side\n    rgb: /side/rgb\n    depth: /side/depth\n    info: /side/calibration\n"
        f"    depth_scale: 0.0001\n    cam_to_world:\n{rows}\n"
    )
    (recording,) = recordings(bag.path, ImportSettings(mapping=str(file)))
    assert (recording.num_frames, recording.num_views) == (NUM_FRAMES, 2)
    np.testing.assert_allclose(recording.cam_to_world[:, 0], [pose(time) for time in TIMES], atol=1e-6)
    np.testing.assert_allclose(recording.cam_to_world[3, 1], fixed, atol=1e-12)
    np.testing.assert_array_equal(recording.read_rgb(3, 1), seen[3].rgb)
    np.testing.assert_allclose(recording.read_depth(3, 1), seen[3].depth, atol=0.00005 + 1e-6)
    assert recording.source["depth_unit"] == "0.001,0.0001"
    assert recording.distortion is not None
    assert recording.distortion.tolist() == [[0.0] * 5, [0.01, 0, 0, 0, 0]]
    with pytest.raises(DataError, match="has 2 RGB-D pairs"):
        list(recordings(bag.path, ImportSettings()))


def test_depth_units_of_realsense_recordings_are_used(tmp_path, pictures):
    rgb, depth = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
    with BagWriter(tmp_path, "ros1") as bag:
        write_transforms(bag)
        unit = "/device_0/sensor_0/option/Depth_Units/value"
        bag.write(unit, "std_msgs/msg/Float32", START, data=0.0001)
        for stamp, picture in zip(STAMPS, pictures, strict=True):
            bag.image(f"{rgb}/image/data", stamp, OPTICAL, "rgb8", picture.rgb)
            tenths = np.rint(picture.depth * 10_000).astype(np.uint16)
            bag.image(f"{depth}/image/data", stamp, OPTICAL, "mono16", tenths)
        bag.info(f"{rgb}/info/camera_info", START, OPTICAL)
        bag.info(f"{depth}/info/camera_info", START, OPTICAL)
    (recording,) = recordings(bag.path, ImportSettings())
    assert float(recording.source["depth_unit"]) == pytest.approx(0.0001, rel=1e-6)
    assert largest_surface_distance(recording, TIMES) < 0.00005 * LONGEST_RAY + 3e-6


def test_two_static_cameras_need_no_moving_pose(tmp_path, pictures):
    with BagWriter(tmp_path, "ros2") as bag:
        bag.transform("/tf_static", START, "world", OPTICAL, pose(0.0))
        write_images(bag, pictures)
    (recording,) = recordings(bag.path, ImportSettings())
    assert recording.cam_to_world.shape == (1, 4, 4)
    np.testing.assert_allclose(recording.cam_to_world[0], pose(0.0), atol=1e-9)


def test_missing_depth_images_cut_the_recording(tmp_path, pictures):
    with BagWriter(tmp_path, "ros2") as bag:
        bag.transform("/tf_static", START, "world", OPTICAL, pose(0.0))
        for frame in range(9):
            stamp = START + frame * 66_666_667
            bag.image(RGB, stamp, OPTICAL, "rgb8", pictures[0].rgb)
            bag.info(INFO, stamp, OPTICAL)
            if frame != 3:
                bag.image(DEPTH, stamp, OPTICAL, "16UC1", millimetres(pictures[0]) + frame)
    parts = list(recordings(bag.path, ImportSettings()))
    assert [(part.name, part.num_frames) for part in parts] == [("made/part0", 3), ("made/part1", 5)]
    expected = (millimetres(pictures[0]) + 4) * np.float32(0.001)
    np.testing.assert_allclose(parts[1].read_depth(0, 0), expected, atol=1e-6)
    np.testing.assert_allclose(parts[0].read_depth(2, 0), expected - 0.002, atol=1e-6)


def test_a_folder_of_bags_is_many_recordings(tmp_path, pictures):
    for name in ("a", "b"):
        with BagWriter(tmp_path, "ros1", name) as bag:
            write_transforms(bag)
            write_images(bag, pictures)
    assert matches(tmp_path)
    first, second = recordings(tmp_path, ImportSettings())
    assert (first.name, second.name) == ("a", "b")
    for frame in range(2):  # in turns: only one bag is open at a time
        np.testing.assert_array_equal(first.read_rgb(frame, 0), pictures[frame].rgb)
        np.testing.assert_array_equal(second.read_rgb(frame, 0), pictures[frame].rgb)


def test_lens_models_are_passed_on(tmp_path, pictures):
    numbers = (0.1, -0.02, 0.001, 0.002, 0.003, 0.01, 0.02, 0.03)
    path = make_bag(tmp_path, pictures, model="rational_polynomial", distortion=numbers)
    (recording,) = recordings(path, ImportSettings())
    assert recording.distortion is not None
    assert recording.distortion.tolist() == [list(numbers)]


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
def test_reads_slow_recordings(tmp_path, pictures, kind):
    stamps = [START + frame * 3 * 10**9 for frame in range(NUM_FRAMES)]  # frames are sought, not read past
    with BagWriter(tmp_path, kind) as bag:
        bag.transform("/tf_static", START, "world", OPTICAL, pose(0.0))
        for stamp, picture in zip(stamps, pictures, strict=True):
            bag.image(RGB, stamp, OPTICAL, "rgb8", picture.rgb)
            bag.image(DEPTH, stamp, OPTICAL, "16UC1", millimetres(picture))
            bag.info(INFO, stamp, OPTICAL)
    (recording,) = recordings(bag.path, ImportSettings())
    assert recording.frame_time == 3.0
    for frame in (0, 1, 3, 2, 4):
        np.testing.assert_array_equal(recording.read_rgb(frame, 0), pictures[frame].rgb)


@pytest.mark.parametrize(("kind", "suffix"), [("ros2", ".db3"), ("mcap", ".mcap")])
def test_reads_the_file_in_a_ros2_folder_by_itself(tmp_path, pictures, kind, suffix):
    (file,) = make_bag(tmp_path, pictures, kind).glob(f"*{suffix}")
    assert matches(file)
    (recording,) = recordings(file, ImportSettings())
    np.testing.assert_array_equal(recording.read_rgb(4, 0), pictures[4].rgb)


def test_reads_older_bags_without_message_definitions(tmp_path, pictures):
    path = make_bag(tmp_path, pictures, "ros2")
    with sqlite3.connect(path / "made.db3") as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    (recording,) = recordings(path, ImportSettings())
    np.testing.assert_array_equal(recording.read_rgb(1, 0), pictures[1].rgb)
    np.testing.assert_allclose(recording.cam_to_world[1, 0], pose(TIMES[1]), atol=5e-6)


def test_a_16_bit_png_of_unsaid_encoding_is_depth(tmp_path, pictures):
    with BagWriter(tmp_path, "ros2") as bag:
        write_transforms(bag)
        for stamp, picture in zip(STAMPS, pictures, strict=True):
            bag.compressed("/cam/rgb/compressed", stamp, OPTICAL, "png", png(picture.rgb[..., ::-1]))
            bag.compressed("/cam/depth/compressed", stamp, OPTICAL, "png", png(millimetres(picture)))
            bag.info("/cam/camera_info", stamp, OPTICAL)
    (recording,) = recordings(bag.path, ImportSettings())
    np.testing.assert_allclose(recording.read_depth(1, 0), pictures[1].depth, atol=HALF_MILLIMETRE + 1e-6)


def write_pair(folder, pictures):
    """A moving and a fixed camera in one bag, and the mapping that names them."""
    fixed = side_pose()
    with BagWriter(folder, "mcap") as bag:
        write_transforms(bag)
        bag.transform("/tf_static", START, "map", "side", fixed)
        write_images(bag, pictures, depth_encoding="32FC1")
        for stamp, time in zip(STAMPS, TIMES, strict=True):
            picture = render(INTRINSICS, fixed, HEIGHT, WIDTH, time)
            bag.image("/side/image_raw", stamp, "side", "rgb8", picture.rgb)
            bag.image("/side/depth", stamp, "side", "32FC1", picture.depth.astype(np.float32))
            bag.info("/side/camera_info", stamp, "side")
    file = folder / "cameras.yaml"
    side = "  - rgb: /side/image_raw\n    depth: /side/depth\n"
    file.write_text(f"cameras:\n  - rgb: {RGB}\n    depth: {DEPTH}\n{side}")
    return bag.path, str(file)


def test_imports_into_a_valid_data_set(tmp_path, pictures):
    path, mapping = write_pair(tmp_path, pictures)
    report = import_and_validate(path, tmp_path / "out", mapping=mapping)
    assert report.faults == []
    with h5py.File(tmp_path / "out" / "train" / "000000.h5") as file:
        assert file.attrs["source_format"] == "ros"
        assert file.attrs["source_axes"] == "opencv"
        assert file.attrs["source_pixel_center"] == "0.0"
        assert file["rgb"].shape == (NUM_FRAMES, 2, HEIGHT, WIDTH, 3)
        np.testing.assert_allclose(file["depth"][2, 0], pictures[2].depth, atol=1e-6)


@pytest.mark.parametrize(
    ("mistake", "suggestion"),
    [
        ({"axes": "opengl"}, "axes are OpenGL's"),
        ({"depth": "distance"}, "depth was z and has been divided by the length of the ray"),
        ({"depth_scale": 1000.0}, "depth is in millimetres"),
        ({"pixel_center": "0.5"}, "add 0.5 to cx and cy"),
    ],
)
def test_validate_names_a_mistaken_convention(tmp_path, pictures, mistake, suggestion):
    path, mapping = write_pair(tmp_path, pictures)
    report = import_and_validate(path, tmp_path / "out", mapping=mapping, **mistake)
    assert not report.is_valid
    assert suggestion in str(report.faults[0])


def test_depth_of_another_sensor_is_registered_where_the_bag_says_where_it_is(tmp_path, pictures):
    to_color = np.eye(4)
    to_color[:3, 3] = [0.03, 0.005, 0.0]
    frame = "camera_depth_optical_frame"
    seen = [render(INTRINSICS, pose(time) @ to_color, HEIGHT, WIDTH, time) for time in TIMES]
    with BagWriter(tmp_path, "ros2") as bag:
        write_transforms(bag)
        bag.transform("/tf_static", START, OPTICAL, frame, to_color)
        for stamp, picture, other in zip(STAMPS, pictures, seen, strict=True):
            bag.image(RGB, stamp, OPTICAL, "rgb8", picture.rgb)
            bag.image("/camera/depth/image_rect_raw", stamp, frame, "16UC1", millimetres(other))
            bag.info(INFO, stamp, OPTICAL)
            bag.info("/camera/depth/camera_info", stamp, frame)
    (recording,) = recordings(bag.path, ImportSettings())
    (sensor,) = recording.depth_cameras
    np.testing.assert_allclose(sensor.to_color, to_color, atol=1e-9)
    registered = ImageGeometry(recording, ImportSettings()).depth(2, 0)
    error = np.abs(registered - pictures[2].depth)[registered > 0]
    assert np.quantile(error, 0.9) < 0.002  # millimetres, and planes between them
    assert (registered > 0).mean() > 0.9
