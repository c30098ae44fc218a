import json
import struct

import cv2
import h5py
import numpy as np
import pytest

from data_gen.importers.kubric_folder import matches, recordings
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
    quaternion_wxyz,
    side_pose,
)
from vpd_lightning.errors import DataError

FRAME_RATE = 12
TIMES = [frame / FRAME_RATE for frame in range(4)]
BACKGROUND = 1e10  # what Blender's depth pass holds where there is nothing


def write_tiff(path, image):
    """A TIFF of one strip of float32 grey, as imageio writes it."""
    height, width = image.shape
    data = image.astype("<f4").tobytes()
    tags = [
        (256, 4, width),
        (257, 4, height),
        (258, 3, 32),  # bits a sample
        (259, 3, 1),  # not compressed
        (262, 3, 1),  # 0 is black
        (273, 4, 8),  # the strip starts behind the header
        (277, 3, 1),  # samples a pixel
        (278, 4, height),
        (279, 4, len(data)),
        (339, 3, 3),  # floating point
    ]
    directory = struct.pack("<H", len(tags))
    for tag, kind, value in tags:
        directory += struct.pack("<HHI", tag, kind, 1) + struct.pack("<I", value)
    path.write_bytes(b"II*\0" + struct.pack("<I", 8 + len(data)) + data + directory + struct.pack("<I", 0))


def write_scene(folder, poses, pictures, sky=()):
    """Write what Kubric's MOVi workers write; ``sky`` lists (frame, row, column) without a surface."""
    folder.mkdir(parents=True)
    sensor_width = 32.0
    focal_length = FOCAL / WIDTH * sensor_width
    sensor_height = sensor_width / WIDTH * HEIGHT
    in_opengl = [opengl(matrix) for matrix in poses]
    metadata = {
        "flags": {"frame_rate": FRAME_RATE, "resolution": f"{WIDTH}x{HEIGHT}"},
        "metadata": {
            "resolution": [WIDTH, HEIGHT],
            "frame_rate": FRAME_RATE,
            "step_rate": 240,
            "gravity": [0, 0, -10.0],
            "num_frames": len(poses),
            "num_instances": 1,
        },
        "camera": {
            "focal_length": focal_length,
            "sensor_width": sensor_width,
            "field_of_view": 2 * np.arctan2(sensor_width / 2, focal_length),
            "positions": [matrix[:3, 3].tolist() for matrix in in_opengl],
            "quaternions": [quaternion_wxyz(matrix).tolist() for matrix in in_opengl],
            "K": [[focal_length / sensor_width, 0, -0.5], [0, -focal_length / sensor_height, -0.5], [0, 0, -1]],
            "R": in_opengl[-1].tolist(),
        },
        "instances": [],
    }
    (folder / "metadata.json").write_text(json.dumps(metadata, sort_keys=True, indent=4))
    (folder / "data_ranges.json").write_text("{}")
    for frame, picture in enumerate(pictures):
        alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
        rgba = np.concatenate([picture.rgb[..., ::-1], alpha], axis=-1)
        assert cv2.imwrite(str(folder / f"rgba_{frame:05d}.png"), rgba)
        distance = picture.distance.copy()
        for index, row, column in sky:
            if index == frame:
                distance[row, column] = BACKGROUND
        write_tiff(folder / f"depth_{frame:05d}.tiff", distance)
    return folder


@pytest.fixture(scope="module")
def known():
    poses = [pose(time) for time in TIMES]
    return poses, [render(INTRINSICS, c2w, HEIGHT, WIDTH, time) for c2w, time in zip(poses, TIMES, strict=True)]


@pytest.fixture
def scene(tmp_path, known):
    return write_scene(tmp_path / "scene", *known, sky=[(0, 3, 5)])


def edit_metadata(folder, change):
    metadata = json.loads((folder / "metadata.json").read_text())
    change(metadata)
    (folder / "metadata.json").write_text(json.dumps(metadata))


def test_recovers_cameras_colours_and_points(scene, known):
    assert matches(scene)
    (recording,) = recordings(scene, ImportSettings())
    poses, pictures = known
    assert (recording.num_frames, recording.num_views) == (4, 1)
    assert recording.frame_time == pytest.approx(1 / FRAME_RATE, abs=1e-12)
    np.testing.assert_allclose(recording.intrinsics, INTRINSICS[None], atol=1e-10, rtol=0)
    np.testing.assert_allclose(recording.cam_to_world[:, 0], poses, atol=1e-12, rtol=0)  # JSON holds every digit
    for frame, picture in enumerate(pictures):
        np.testing.assert_array_equal(recording.read_rgb(frame, 0), picture.rgb)
        expected = picture.depth.copy()
        if frame == 0:
            expected[3, 5] = 0
        np.testing.assert_allclose(recording.read_depth(frame, 0), expected, atol=2e-6)  # float32 in the file
    assert largest_surface_distance(recording, TIMES) < 1e-5


def test_records_what_it_converted(scene):
    (recording,) = recordings(scene, ImportSettings())
    assert recording.source["format"] == "kubric"
    assert recording.source["axes"] == "opengl"
    assert recording.source["depth_type"] == "distance"
    assert recording.source["pixel_center"] == "0.5"


def test_conventions_can_be_overruled(scene, known):
    (recording,) = recordings(scene, ImportSettings(axes="opencv", depth="z", pixel_center="0.0", depth_scale=0.5))
    np.testing.assert_allclose(recording.cam_to_world[0, 0], opengl(known[0][0]), atol=1e-12)
    np.testing.assert_allclose(recording.read_depth(1, 0), 0.5 * known[1][1].distance, atol=1e-6)
    assert recording.intrinsics[0, 0, 2] == WIDTH / 2 + 0.5


def test_a_still_camera_has_one_pose(tmp_path, known):
    still = write_scene(tmp_path / "still", [known[0][0]] * 4, [known[1][0]] * 4)
    (recording,) = recordings(still, ImportSettings())
    assert recording.cam_to_world.shape == (1, 4, 4)


def test_reads_files_of_older_versions_without_resolution(scene, known):
    def older(metadata):
        metadata["metadata"] = {"width": WIDTH, "height": HEIGHT, "num_frames": 4, "num_instances": 1}
        del metadata["camera"]["focal_length"]

    edit_metadata(scene, older)
    (recording,) = recordings(scene, ImportSettings())
    np.testing.assert_allclose(recording.intrinsics, INTRINSICS[None], atol=1e-10)  # from the horizontal field of view
    assert recording.frame_time == pytest.approx(1 / FRAME_RATE)


def test_a_folder_of_scenes_and_a_scene_of_views(tmp_path, known):
    poses, pictures = known
    for number in (2, 10, 1):
        write_scene(tmp_path / "many" / str(number), poses, pictures)
    assert matches(tmp_path / "many")
    assert [recording.name for recording in recordings(tmp_path / "many", ImportSettings())] == ["1", "2", "10"]

    second = [side_pose(time) for time in TIMES]
    seen = [render(INTRINSICS, c2w, HEIGHT, WIDTH, time) for c2w, time in zip(second, TIMES, strict=True)]
    write_scene(tmp_path / "rig" / "view_0", poses, pictures)
    write_scene(tmp_path / "rig" / "view_1", second, seen)
    (recording,) = recordings(tmp_path / "rig", ImportSettings())
    assert (recording.name, recording.num_views) == ("rig", 2)
    np.testing.assert_allclose(recording.cam_to_world[:, 1], second, atol=1e-12)
    assert largest_surface_distance(recording, TIMES) < 1e-5


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "depth_00002.tiff").unlink(), "frame 2 lacks its colour or its depth"),
        (lambda f: [(f / f"{n}").unlink() for n in ("depth_00003.tiff", "rgba_00003.png")], "metadata.json says 4"),
        (lambda f: [path.unlink() for path in f.glob("depth*")], "has no depth_00000.tiff"),
        (lambda f: (f / "metadata.json").write_text("{"), "cannot be read as JSON"),
        (lambda f: edit_metadata(f, lambda m: m.pop("camera")), "lacks 'camera'"),
        (lambda f: edit_metadata(f, lambda m: m["camera"].pop("quaternions")), "has no quaternions"),
        (lambda f: edit_metadata(f, lambda m: m["camera"]["positions"].pop()), "3 positions for 4 frames"),
        (
            lambda f: edit_metadata(f, lambda m: m["camera"]["quaternions"][2].__setitem__(0, 3.0)),
            "quaternion has length",
        ),
    ],
)
def test_names_what_is_missing_or_broken(scene, damage, message):
    damage(scene)
    with pytest.raises(DataError, match=message):
        list(recordings(scene, ImportSettings()))


def test_names_a_damaged_image_when_it_is_read(scene):
    path = scene / "depth_00001.tiff"
    path.write_bytes(path.read_bytes()[:100])
    (recording,) = recordings(scene, ImportSettings())
    with pytest.raises(DataError, match="depth_00001.tiff cannot be read as an image"):
        recording.read_depth(1, 0)


def write_rig(folder, known):
    """One scene seen by two moving cameras."""
    second = [side_pose(time) for time in TIMES]
    seen = [render(INTRINSICS, c2w, HEIGHT, WIDTH, time) for c2w, time in zip(second, TIMES, strict=True)]
    write_scene(folder / "view_0", *known)
    write_scene(folder / "view_1", second, seen)
    return folder


def test_imports_into_a_valid_data_set(tmp_path, known):
    report = import_and_validate(write_rig(tmp_path / "rig", known), tmp_path / "out")
    assert report.faults == []
    with h5py.File(tmp_path / "out" / "train" / "000000.h5") as file:
        assert file.attrs["source_format"] == "kubric"
        assert file.attrs["source_axes"] == "opengl"
        assert file.attrs["source_depth_type"] == "distance"
        np.testing.assert_allclose(file["cam_to_world"][:, 0], known[0], atol=1e-12)
        np.testing.assert_allclose(file["depth"][1, 0], known[1][1].depth, atol=2e-6)


@pytest.mark.parametrize(
    ("mistake", "suggestion"),
    [
        ({"axes": "opencv"}, "axes are OpenGL's"),
        ({"depth": "z"}, "depth is the distance to the camera centre"),
        ({"depth_scale": 1000}, "depth is in millimetres"),
    ],
)
def test_validate_names_a_mistaken_convention(tmp_path, known, mistake, suggestion):
    report = import_and_validate(write_rig(tmp_path / "rig", known), tmp_path / "out", **mistake)
    assert not report.is_valid
    assert suggestion in str(report.faults[0])
