"""Cleaning measured depth: on a scene known in closed form, seen by simulated sensors at a camera's own resolution."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from data_gen.importers.depth_cleanup import HoleFiller, smoothed, without_flying_pixels
from data_gen.importers.image_geometry import ImageGeometry
from data_gen.importers.images import pixel_centers, sample_depth
from data_gen.importers.recording import Recording
from data_gen.importers.run import import_recordings
from data_gen.importers.settings import load_import_settings
from tests.data_gen.importers import known_scene
from tests.data_gen.importers.checks import files
from tests.data_gen.importers.plain_recording import change, write_plain
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.sensors import Sensor, load_sensor
from vpd_lightning.errors import ConfigError

SENSORS = ("structured_light", "active_stereo", "time_of_flight")
HEIGHT, WIDTH = 240, 320
INTRINSICS, POSE = known_scene.camera(30, 55, 2.0, HEIGHT, WIDTH)
FOCAL_LENGTH = float(INTRINSICS[0, 0])
TRUE = known_scene.render(INTRINSICS, POSE, HEIGHT, WIDTH, 0.0).depth.astype(np.float32)


def measured(name: str) -> np.ndarray:
    sensor = Sensor(load_sensor(name), seed=0, trajectory="t", median_depth=float(np.median(TRUE)))
    return sensor.measure_depth(TRUE, INTRINSICS, 0, 0)


def geometry(depth: np.ndarray, **settings) -> ImageGeometry:
    rgb = np.zeros((*depth.shape, 3), np.uint8)
    recording = Recording(
        "r", *depth.shape, INTRINSICS[None], POSE[None], 3, 1, 0.1, lambda t, v: rgb, lambda t, v: depth
    )
    return ImageGeometry(recording, load_import_settings(settings))


def median_error(depth: np.ndarray, intrinsics: np.ndarray) -> float:
    """Median distance in metres of the measured points from the true surfaces."""
    points = known_scene.unproject(depth, intrinsics, POSE)
    return float(np.median(known_scene.distance_to_surfaces(points, 0.0)))


@pytest.mark.parametrize("name", SENSORS)
def test_pixels_in_the_air_go_and_others_stay(name: str) -> None:
    depth = measured(name)
    near, far = minimum_filter(TRUE, 5), maximum_filter(TRUE, 5)
    is_in_air = (depth > near * 1.03) & (depth < far * 0.97) & (np.abs(depth - TRUE) > 0.03 * TRUE)
    assert is_in_air.sum() > 50
    kept = without_flying_pixels(depth, FOCAL_LENGTH, 0.02) > 0
    assert (is_in_air & kept).sum() <= 0.2 * is_in_air.sum()
    assert ((depth > 0) & ~is_in_air & ~kept).sum() <= 0.002 * depth.size


def test_of_perfect_depth_nothing_is_removed_up_to_a_steep_view() -> None:
    columns = np.arange(WIDTH) - WIDTH / 2
    for degrees in (0.0, 40.0, 75.0):  # a wall turned so far from facing the camera
        wall = 2.0 / (1 - np.tan(np.radians(degrees)) * columns / (4 * WIDTH))
        depth = np.repeat(wall[None], HEIGHT, axis=0).astype(np.float32)
        assert np.array_equal(without_flying_pixels(depth, 4 * WIDTH, 0.02), depth)
    assert np.array_equal(without_flying_pixels(TRUE, FOCAL_LENGTH, 0.02), TRUE)


def test_noise_is_not_taken_for_jumps() -> None:
    noise = np.random.default_rng(0).standard_normal((HEIGHT, WIDTH)).astype(np.float32)
    depth = np.float32(18.0) * (1 + np.float32(0.035) * noise)
    assert (without_flying_pixels(depth, FOCAL_LENGTH, 0.02) > 0).mean() > 0.99


def test_a_pixel_by_itself_goes_and_what_was_not_measured_stays_so() -> None:
    depth = np.full((7, 7), 2.0, np.float32)
    depth[3, 3], depth[0, 0] = 1.5, 0.0
    cleaned = without_flying_pixels(depth, 500.0, 0.02)
    assert cleaned[3, 3] == 0 and cleaned[0, 0] == 0 and (cleaned > 0).sum() == 47


@pytest.mark.parametrize("name", SENSORS)
def test_smoothing_takes_away_noise_and_keeps_edges_and_holes(name: str) -> None:
    depth = measured(name)
    clean = smoothed(depth, 2.0)
    assert median_error(clean, INTRINSICS) < 0.75 * median_error(depth, INTRINSICS)
    assert np.array_equal(clean > 0, depth > 0)
    step = np.abs(np.diff(TRUE, axis=1)) > 0.1  # across the box's outline
    sides = [(clean[:, 1:], TRUE[:, 1:]), (clean[:, :-1], TRUE[:, :-1])]
    for side, true in sides:
        is_right = (side > 0) & (np.abs(side - true) < 0.03 * true)
        was_right = (side > 0) & (
            np.abs(np.where(side is sides[0][0], depth[:, 1:], depth[:, :-1]) - true) < 0.03 * true
        )
        assert is_right[step].mean() > was_right[step].mean() - 0.05


def test_smoothing_leaves_planes_and_empty_images_as_they_are() -> None:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    plane = (1 / (0.5 + 2e-4 * rows + 1e-4 * columns)).astype(np.float32)
    inner = np.s_[20:-20, 20:-20]
    assert np.abs(smoothed(plane, 2.0) / plane - 1)[inner].max() < 2e-5
    empty = np.zeros((4, 4), np.float32)
    assert np.array_equal(smoothed(empty, 2.0), empty)


@pytest.mark.parametrize("name", SENSORS)
def test_a_smaller_picture_averages_noise_within_surfaces(name: str) -> None:
    depth = measured(name)
    small = geometry(depth, height=48)
    intrinsics = small.intrinsics()[0]
    rows, columns = np.meshgrid(pixel_centers(48, HEIGHT), pixel_centers(64, WIDTH), indexing="ij")
    middle = sample_depth(depth, rows, columns)
    mean = small.depth(0, 0)
    assert median_error(mean, intrinsics) < 0.75 * median_error(middle, intrinsics)
    assert (mean > 0).sum() >= (middle > 0).sum()
    near, far = minimum_filter(TRUE, 9), maximum_filter(TRUE, 9)
    rows, columns = np.rint(rows).astype(int), np.rint(columns).astype(int)
    is_outside = (mean > 0) & ((mean < 0.96 * near[rows, columns]) | (mean > 1.04 * far[rows, columns]))
    assert is_outside.mean() < 0.002


def test_a_smaller_picture_of_perfect_depth_is_exact() -> None:
    """Also on the crease where box and floor meet, which a plain average would round."""
    points = known_scene.unproject(
        geometry(TRUE, height=40).depth(0, 0), geometry(TRUE, height=40).intrinsics()[0], POSE
    )
    distances = known_scene.distance_to_surfaces(points, 0.0)
    middles = pixel_centers(40, HEIGHT)
    rows, columns = np.meshgrid(middles, pixel_centers(53, WIDTH), indexing="ij")
    plain = known_scene.unproject(sample_depth(TRUE, rows, columns), geometry(TRUE, height=40).intrinsics()[0], POSE)
    assert distances.max() <= known_scene.distance_to_surfaces(plain, 0.0).max() + 1e-4
    assert np.quantile(distances, 0.95) < 1e-4


def test_a_hole_is_filled_by_what_a_still_camera_saw_there() -> None:
    fill = HoleFiller(3)
    wall = np.full((9, 9), 2.0, np.float32)
    hole = wall.copy()
    hole[4, 4] = 0
    assert fill(wall)[4, 4] == 2
    assert fill(wall)[4, 4] == 2
    assert [fill(hole)[4, 4] for _ in range(5)] == [2, 2, 2, 0, 0]


def test_what_was_seen_once_only_fills_nothing() -> None:
    fill = HoleFiller(3)
    wall = np.full((9, 9), 2.0, np.float32)
    hole = wall.copy()
    hole[4, 4] = 0
    fill(hole), fill(wall)
    assert fill(hole)[4, 4] == 0


def test_a_hole_in_something_that_moves_stays_a_hole() -> None:
    """Also after it has passed: behind it only what was measured again counts."""
    fill = HoleFiller(10)
    wall = np.full((9, 9), 2.0, np.float32)
    fill(wall), fill(wall)
    body = wall.copy()
    body[2:7, 2:7] = 1.0
    body[4, 4] = 0
    assert fill(body)[4, 4] == 0
    assert fill(body)[4, 4] == 0
    far_off = wall.copy()
    far_off[2:7, 2:7] = 1.0
    far_off[0, 8] = 0
    assert fill(far_off)[0, 8] == 2


def test_a_wide_hole_where_something_left_is_not_filled_with_it_not_even_in_its_middle() -> None:
    fill = HoleFiller(10)
    body = np.full((21, 21), 2.0, np.float32)
    body[3:18, 3:18] = 1.0
    fill(body), fill(body)
    left = np.full((21, 21), 2.0, np.float32)
    left[4:17, 4:17] = 0  # only a rim of what is behind the body is measured
    assert (fill(left)[4:17, 4:17] == 0).all()
    assert (fill(left)[4:17, 4:17] == 0).all()


def test_holes_of_an_import_are_filled_from_earlier_frames_alone(tmp_path: Path) -> None:
    source = write_plain(tmp_path / "take", num_frames=6, num_views=1, depth="npy")
    stored = sorted((source / "view0" / "depth").glob("*.npy"))
    for number, path in enumerate(stored):
        depth = np.load(path)
        depth[3, 5 if number in (0, 1, 4) else 50] = 0  # a corner of the floor, far from the box
        np.save(path, depth)
    out = import_recordings(source, tmp_path / "out", {"fill_holes": 4, "splits.train": 1})
    plain = import_recordings(source, tmp_path / "plain", {})
    with TrajectoryReader(files(out)[0]) as filled, TrajectoryReader(files(plain)[0]) as raw:
        now, before = filled.depth(range(6), [0])[:, 0], raw.depth(range(6), [0])[:, 0]
    assert (now[:2, 3, 5] == 0).all() and now[4, 3, 5] == before[3, 3, 5] > 0
    assert np.array_equal(now[before > 0], before[before > 0])


def test_holes_of_a_moving_camera_cannot_be_filled(tmp_path: Path) -> None:
    source = write_plain(tmp_path / "take", num_frames=4, num_views=1)
    views = change(source)["views"]
    poses = np.repeat(np.array(views[0]["cam_to_world"])[None], 4, axis=0)
    poses[:, 0, 3] += 0.01 * np.arange(4)  # one pose for each frame
    views[0]["cam_to_world"] = poses.tolist()
    change(source, views=views)
    with pytest.raises(ConfigError, match="fill_holes=4 needs cameras that stand still"):
        import_recordings(source, tmp_path / "out", {"fill_holes": 4})


@pytest.mark.parametrize("setting", [{"flying_pixels": 0}, {"flying_pixels": 2}, {"smooth": -1}, {"fill_holes": 0}])
def test_values_out_of_range_are_refused(setting: dict) -> None:
    with pytest.raises(ConfigError, match=f"{next(iter(setting))} is"):
        load_import_settings(setting)
