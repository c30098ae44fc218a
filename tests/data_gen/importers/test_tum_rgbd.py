import cv2
import h5py
import numpy as np
import pytest

from data_gen.importers.frame_times import PoseTrack, nearest, runs_without_gap
from data_gen.importers.settings import ImportSettings
from data_gen.importers.tum_rgbd import matches, recordings
from tests.data_gen.importers.known_scene import distance_to_surfaces, render, unproject
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
)
from vpd_lightning.errors import DataError

START = 1305031102.175304  # s since 1970, as in the published sequences
NUM_FRAMES = 6
TIMES = [round(frame / 30 + 0.002 * np.sin(7 * frame), 6) for frame in range(NUM_FRAMES)]  # jittered colour images
HALF_STEP = 0.5 / 5000  # m; depth is rounded to 5000 steps a metre
LONGEST_RAY = float(np.sqrt(1 + (WIDTH / 2 / FOCAL) ** 2 + (HEIGHT / 2 / FOCAL) ** 2))  # per metre of depth


def write_sequence(folder, times, pictures, calibration=True, poses_at=None, depth_shift=0.011):
    """The three lists and two image folders; depth comes 11 ms after colour, poses at 100 Hz at times of their own."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    rgb, depth = (
        ["# color images", "# file: 'made.bag'", "# timestamp filename"],
        ["# depth maps", "# timestamp filename"],
    )
    for number, (time, picture) in enumerate(zip(times, pictures, strict=True)):
        seen, measured = f"{START + time:.6f}", f"{START + time + depth_shift + 0.003 * np.cos(number):.6f}"
        rgb.append(f"{seen} rgb/{seen}.png")
        depth.append(f"{measured} depth/{measured}.png")
        assert cv2.imwrite(str(folder / f"rgb/{seen}.png"), picture.rgb[..., ::-1])
        assert cv2.imwrite(str(folder / f"depth/{measured}.png"), np.rint(picture.depth * 5000).astype(np.uint16))
    lines = ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
    for time in np.arange(-0.0137, times[-1] + 0.05, 0.01) if poses_at is None else poses_at:
        matrix = pose(time)
        w, x, y, z = quaternion_wxyz(matrix)
        values = [*matrix[:3, 3], x, y, z, w]
        lines.append(f"{START + time:.6f} " + " ".join(f"{value:.10f}" for value in values))
    for name, content in (("rgb", rgb), ("depth", depth), ("groundtruth", lines)):
        (folder / f"{name}.txt").write_text("\n".join(content) + "\n")
    if calibration:  # pixel centres at integers
        numbers = f"fx: {FOCAL}\nfy: {FOCAL}\ncx: {WIDTH / 2 - 0.5}\ncy: {HEIGHT / 2 - 0.5}\n"
        (folder / "calibration.yaml").write_text(numbers)
    return folder


@pytest.fixture(scope="module")
def pictures():
    return [render(INTRINSICS, pose(time), HEIGHT, WIDTH, time) for time in TIMES]


@pytest.fixture
def sequence(tmp_path, pictures):
    return write_sequence(tmp_path / "rgbd_dataset_made", TIMES, pictures)


def test_recovers_cameras_colours_and_points(sequence, pictures):
    assert matches(sequence) and matches(sequence.parent)
    (recording,) = recordings(sequence, ImportSettings())
    assert (recording.name, recording.num_frames, recording.num_views) == ("rgbd_dataset_made", NUM_FRAMES, 1)
    assert recording.frame_time == pytest.approx(1 / 30, abs=0.003)
    np.testing.assert_allclose(recording.intrinsics, INTRINSICS[None], atol=1e-12)  # half a pixel was added
    # Poses are interpolated between 100 Hz samples with ten digits, at times with six.
    np.testing.assert_allclose(recording.cam_to_world[:, 0], [pose(time) for time in TIMES], atol=2e-6, rtol=0)
    for frame, picture in enumerate(pictures):
        np.testing.assert_array_equal(recording.read_rgb(frame, 0), picture.rgb)
        np.testing.assert_allclose(recording.read_depth(frame, 0), picture.depth, atol=HALF_STEP + 1e-6)
    assert largest_surface_distance(recording, TIMES) < HALF_STEP * LONGEST_RAY + 3e-6
    assert recording.source["format"] == "tum"
    assert recording.source["axes"] == "opencv"
    assert recording.source["depth_type"] == "z"
    assert recording.source["pixel_center"] == "0.0"
    assert float(recording.source["depth_unit"]) == pytest.approx(1 / 5000)


def test_conventions_can_be_overruled(sequence, pictures):
    changed = ImportSettings(axes="opengl", depth="distance", pixel_center="0.5", depth_scale=0.001)
    (recording,) = recordings(sequence, changed)
    np.testing.assert_allclose(recording.cam_to_world[0, 0], opengl(pose(TIMES[0])), atol=2e-6)
    assert recording.intrinsics[0, 0, 2] == WIDTH / 2 - 0.5
    row, column = HEIGHT // 2, WIDTH // 2  # the ray nearest to the axis: a unit long to 1e-4
    expected = pictures[0].depth[row, column] * 5
    assert recording.read_depth(0, 0)[row, column] == pytest.approx(expected, rel=3e-4)


@pytest.mark.parametrize(
    ("name", "focal", "center", "distortion"),
    [
        ("rgbd_dataset_freiburg1_desk", (517.3, 516.5), (318.6, 255.3), [0.2624, -0.9531, -0.0054, 0.0026, 1.1633]),
        ("fr2_xyz", (520.9, 521.0), (325.1, 249.7), [0.2312, -0.7849, -0.0033, -0.0001, 0.9172]),
        ("rgbd_dataset_freiburg3_walking_xyz", (535.4, 539.2), (320.1, 247.6), None),
    ],
)
def test_knows_the_published_cameras_by_name(tmp_path, pictures, name, focal, center, distortion):
    folder = write_sequence(tmp_path / name, TIMES[:3], pictures[:3], calibration=False)
    (recording,) = recordings(folder, ImportSettings())
    fx, fy = focal
    cx, cy = center
    np.testing.assert_allclose(recording.intrinsics[0], [[fx, 0, cx + 0.5], [0, fy, cy + 0.5], [0, 0, 1]], atol=1e-12)
    if distortion is None:
        assert recording.distortion is None
    else:
        assert recording.distortion is not None
        assert recording.distortion.tolist() == [distortion]


def test_calibration_may_come_from_a_named_file(sequence, tmp_path):
    file = tmp_path / "kinect.yaml"
    file.write_text("fx: 80\nfy: 81\ncx: 30\ncy: 20\ndistortion: [0.1, 0, 0, 0]\ndepth_scale: 0.001\n")
    (recording,) = recordings(sequence, ImportSettings(mapping=str(file)))
    assert recording.intrinsics[0].tolist() == [[80, 0, 30.5], [0, 81, 20.5], [0, 0, 1]]
    assert recording.distortion is not None
    assert recording.distortion.tolist() == [[0.1, 0, 0, 0, 0]]
    assert recording.source["depth_unit"] == "0.001"


def test_missing_frames_cut_the_sequence(tmp_path, pictures):
    times = [0.0, 1 / 30, 2 / 30, 5 / 30, 6 / 30, 7 / 30, 8 / 30, 12 / 30]
    seen = [pictures[0]] * len(times)
    folder = write_sequence(tmp_path / "cut", times, seen)
    parts = list(recordings(folder, ImportSettings()))
    assert [(part.name, part.num_frames) for part in parts] == [("cut/part0", 3), ("cut/part1", 4)]
    np.testing.assert_allclose(parts[1].cam_to_world[0, 0], pose(times[3]), atol=2e-6)
    assert all(part.frame_time == pytest.approx(1 / 30, abs=1e-5) for part in parts)


def test_a_depth_image_is_used_once_only(sequence):
    lines = (sequence / "depth.txt").read_text().splitlines()
    (sequence / "depth.txt").write_text("\n".join(lines[:4] + lines[5:]) + "\n")  # without the third depth image
    (recording,) = recordings(sequence, ImportSettings(max_time_difference=0.1))
    assert recording.num_frames == 3  # frames 3 to 5; 0 and 1 alone are too few


def edit(folder, name, change):
    path = folder / name
    path.write_text(change(path.read_text()))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "groundtruth.txt").unlink(), "has no groundtruth.txt. Without poses"),
        (lambda f: (f / "depth.txt").unlink(), "has no depth.txt"),
        (lambda f: (f / "calibration.yaml").unlink(), "calibration is missing"),
        (lambda f: (f / "calibration.yaml").write_text("fx: 1"), "lacks the numbers"),
        (lambda f: edit(f, "rgb.txt", lambda t: "# nothing\n"), "lists no image"),
        (lambda f: edit(f, "rgb.txt", lambda t: t.replace("rgb/", "../")), "leads out of"),
        (lambda f: edit(f, "rgb.txt", lambda t: t.replace("1305031102", "noon")), "line 4: .* is not a time"),
        (lambda f: edit(f, "groundtruth.txt", lambda t: t + "1305031105.0 1 2 3 0 0 0 2\n"), "unit quaternion"),
        (lambda f: edit(f, "groundtruth.txt", lambda t: t + "1305031105.0 1 2 nan 0 0 0 1\n"), "unit quaternion"),
        (
            lambda f: edit(f, "depth.txt", lambda t: t.replace("13050311", "13050312")),
            "0 have a depth image within 0.02 s and 6 a pose",
        ),
    ],
)
def test_names_what_is_missing_or_wrong(sequence, damage, message):
    damage(sequence)
    with pytest.raises(DataError, match=message):
        list(recordings(sequence, ImportSettings()))


def test_names_a_damaged_image_when_it_is_read(sequence):
    path = sorted((sequence / "rgb").iterdir())[1]
    path.write_bytes(path.read_bytes()[:40])
    (recording,) = recordings(sequence, ImportSettings())
    with pytest.raises(DataError, match=path.name):
        recording.read_rgb(1, 0)


def test_frames_without_a_pose_nearby_are_left_out(tmp_path, pictures):
    known = [*np.arange(-0.01, 0.08, 0.01), 0.2]
    folder = write_sequence(tmp_path / "lost", TIMES, pictures, poses_at=known)
    (recording,) = recordings(folder, ImportSettings())
    assert recording.num_frames == 3


def test_nearest_gives_each_image_once():
    times = np.array([0, 100, 200, 400])
    assert nearest(times, np.array([10, 90, 120, 310, 420]), 50).tolist() == [0, 1, -1, -1, 3]
    assert nearest(np.array([5]), np.array([0, 4, 100]), 10).tolist() == [-1, 0, -1]
    assert nearest(np.zeros(0, np.int64), np.array([1]), 10).tolist() == [-1]


def test_runs_have_neither_gaps_nor_too_few_frames():
    times = np.array([0, 10, 20, 40, 50, 70, 80, 90, 100]) * 10**6
    assert runs_without_gap(times, 0.01) == [slice(0, 3), slice(5, 9)]


def test_poses_are_known_between_near_samples_only():
    quarter = np.array([[0.0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    track = PoseTrack(np.array([0, 100, 300]), np.stack([np.eye(4), quarter, np.eye(4)]))
    poses, known = track.at(np.array([-1, 0, 70, 100, 200, 300, 301]), 150)
    assert known.tolist() == [False, True, True, True, False, True, False]
    c, s = np.cos(np.radians(63)), np.sin(np.radians(63))  # 70 % of a quarter turn
    np.testing.assert_allclose(poses[2], [[c, -s, 0, 0.7], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], atol=1e-12)


def test_imports_into_a_valid_data_set(sequence, tmp_path):
    report = import_and_validate(sequence, tmp_path / "out")
    assert report.faults == []
    with h5py.File(tmp_path / "out" / "train" / "000000.h5") as file:
        assert file.attrs["source_format"] == "tum"
        assert file.attrs["source_pixel_center"] == "0.0"
        assert file.attrs["frame_time"] == pytest.approx(1 / 30, abs=0.001)
        np.testing.assert_allclose(file["cam_to_world"][:, 0], [pose(time) for time in TIMES], atol=5e-6)


@pytest.mark.parametrize(
    ("mistake", "suggestion"),
    [
        ({"axes": "opengl"}, "axes are OpenGL's"),
        ({"depth": "distance"}, "depth was z and has been divided by the length of the ray"),
        ({"depth_scale": 0.2}, "depth is in millimetres"),
        ({"pixel_center": "0.5"}, "add 0.5 to cx and cy"),
    ],
)
def test_validate_names_a_mistaken_convention(sequence, tmp_path, mistake, suggestion):
    report = import_and_validate(sequence, tmp_path / "out", **mistake)
    assert not report.is_valid
    assert suggestion in str(report.faults[0])


def test_undistorts_the_lens_on_import(tmp_path):
    lens = np.array([0.15, -0.2, -0.005, 0.003, 0.1])
    seen = [render(INTRINSICS, pose(time), HEIGHT, WIDTH, time, lens) for time in TIMES]
    folder = write_sequence(tmp_path / "bent", TIMES, seen)
    with (folder / "calibration.yaml").open("a") as file:
        file.write(f"distortion: {lens.tolist()}\n")
    report = import_and_validate(folder, tmp_path / "out")
    assert report.is_valid
    with h5py.File(tmp_path / "out" / "train" / "000000.h5") as file:
        depth, intrinsics, cam_to_world = file["depth"][:], file["intrinsics"][:], file["cam_to_world"][:]
        assert bool(file.attrs["source_undistorted"])
    far_off = []
    for frame, time in enumerate(TIMES):
        points = unproject(depth[frame, 0], intrinsics[0], cam_to_world[frame, 0])
        far_off.append(distance_to_surfaces(points, time))
    # Nearest-pixel resampling keeps a depth up to half a pixel off its ray: a few millimetres on slanted surfaces.
    assert np.quantile(np.concatenate(far_off), 0.9) < 0.02
