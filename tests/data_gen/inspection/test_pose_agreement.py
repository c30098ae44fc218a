"""A camera that stands a little off is found under noise, and correct cameras are left alone."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from data_gen.inspection.camera_conventions import CameraConvention, single_mistakes
from data_gen.inspection.fault import Fault
from data_gen.inspection.pose_agreement import explanation, misplacements, outlier_views
from data_gen.inspection.validate import check_dataset
from tests.data.analytic_scene import known_trajectory
from tests.data_gen.inspection.mistakes import Change, as_distance, inverted, opengl, positions_in_millimetres, shifted
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.schema import Trajectory, write_trajectory
from vpd_lightning.data.sensors import Sensor, load_sensor
from vpd_lightning.data.sensors.sensor import median_depth

SENSORS = ["structured_light", "active_stereo", "time_of_flight"]


@cache
def recorded(sensor: str, seed: int = 0) -> Trajectory:
    """Three cameras two metres from boxes between a floor and a wall."""
    truth = known_trajectory(seed, height=96, width=128)
    settings = load_sensor(sensor)
    if settings is None:
        return truth
    camera = Sensor(settings, seed=seed, trajectory="0", median_depth=median_depth(truth.depth, truth.far))
    depth = truth.depth.copy()
    intrinsics = np.broadcast_to(truth.intrinsics, (*depth.shape[:2], 3, 3))
    for time, view in np.ndindex(*depth.shape[:2]):
        depth[time, view] = camera.measure_depth(depth[time, view], intrinsics[time, view], time, view)
    return replace(truth, depth=depth)


def moved(trajectory: Trajectory, view: int, shift: list[float]) -> Trajectory:
    poses = trajectory.cam_to_world.copy()
    poses[..., view, :3, 3] += shift
    return replace(trajectory, cam_to_world=poses)


def faults(folder: Path, trajectory: Trajectory) -> list[Fault]:
    path = folder / "000000.h5"
    write_trajectory(path, trajectory)
    return [fault for fault in check_dataset(path).faults if fault.is_error]


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("sensor", ["none", *SENSORS])
def test_a_correct_recording_passes_whatever_the_sensor(tmp_path: Path, sensor: str, seed: int):
    assert not faults(tmp_path, recorded(sensor, seed))


@pytest.mark.parametrize("shift", [[0.0, 0.03, 0.0], [0.0, 0.0, 0.03]], ids=["towards the wall", "upwards"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_a_camera_three_centimetres_off_is_named(tmp_path: Path, sensor: str, shift: list[float]):
    found = faults(tmp_path, moved(recorded(sensor), 1, shift))

    assert [fault.name for fault in found] == ["pose_off"]
    assert "the pose of view 1 is off" in found[0].message


def test_how_far_off_a_camera_is_and_how_surely_it_is_known(tmp_path: Path):
    path = tmp_path / "000000.h5"
    write_trajectory(path, moved(recorded("structured_light"), 1, [0.0, 0.03, 0.0]))

    with TrajectoryReader(path) as reader:
        found = misplacements(reader, max_pairs=6)

    worst = outlier_views(found)
    assert worst is not None and worst[0] == (1,)
    assert worst[1].distance == pytest.approx(0.03, abs=0.005)
    others = [item for item in found if 1 not in item.views]
    assert others and all(item.distance < 0.003 and item.error < 0.002 for item in others)


def test_which_of_two_cameras_is_off_nobody_can_tell(tmp_path: Path):
    three = moved(recorded("structured_light"), 1, [0.0, 0.0, 0.03])
    two = replace(
        three,
        rgb=three.rgb[:, :2],
        depth=three.depth[:, :2],
        intrinsics=three.intrinsics[..., :2, :, :] if three.intrinsics.ndim > 2 else three.intrinsics,
        cam_to_world=three.cam_to_world[..., :2, :, :],
    )

    (found,) = faults(tmp_path, two)

    assert found.name == "pose_off" and "the pose of view 0 or view 1 is off: their surfaces lie" in found.message


@pytest.mark.parametrize("sensor", ["structured_light", "active_stereo"])
@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (opengl, "OpenGL"),
        (inverted, "world_to_cam: invert it"),
        (as_distance, "distance"),
        (positions_in_millimetres, ""),
        (lambda trajectory: replace(trajectory, cam_to_world=trajectory.cam_to_world[..., [1, 0, 2], :, :]), ""),
    ],
    ids=["axes", "inverted poses", "distance", "unit", "swapped cameras"],
)
def test_mistakes_are_named_in_spite_of_noise(tmp_path: Path, sensor: str, mistake: Change, words: str):
    found = faults(tmp_path, mistake(recorded(sensor)))

    assert found and any(words in fault.message for fault in found), [fault.message for fault in found]


def test_half_a_pixel_is_told_by_single_points_on_exact_data_and_by_all_together_under_noise(tmp_path: Path):
    (tmp_path / "exact").mkdir()
    exact = faults(tmp_path / "exact", shifted(0.5)(recorded("none")))
    path = tmp_path / "000000.h5"
    write_trajectory(path, shifted(0.5)(recorded("active_stereo")))
    noisy = check_dataset(path).faults

    assert any("principal point" in fault.message for fault in exact)
    assert any(fault.name == "cannot_tell" and "principal point" in fault.message for fault in noisy)
    (told,) = [fault for fault in noisy if fault.name == "views_disagree"]
    assert "subtract 0.5 from cx and cy, but calibration errors of this size look alike" in told.message
    assert not any(fault.name == "pose_off" for fault in noisy)  # no single camera is to blame


def explained(folder: Path, trajectory: Trajectory) -> CameraConvention | None:
    path = folder / "000000.h5"
    write_trajectory(path, trajectory)
    with TrajectoryReader(path) as reader:
        return explanation(reader, 6, single_mistakes(), misplacements(reader, 6))


@pytest.mark.parametrize("sensor", ["structured_light", "active_stereo"])
@pytest.mark.parametrize(
    ("mistake", "convention"),
    [(as_distance, CameraConvention(ray_power=-1)), (shifted(0.5), CameraConvention(pixel_shift=-0.5))],
    ids=["distance", "half a pixel"],
)
def test_all_points_together_tell_conventions_that_noise_hides(
    tmp_path: Path, sensor: str, mistake: Change, convention: CameraConvention
):
    assert explained(tmp_path, mistake(recorded(sensor))) == convention


@pytest.mark.parametrize("sensor", ["none", "active_stereo"])
def test_no_convention_explains_what_is_right_or_one_camera_that_stands_wrong(tmp_path: Path, sensor: str):
    assert explained(tmp_path, recorded(sensor)) is None
    assert explained(tmp_path, moved(recorded(sensor), 1, [0.0, 0.03, 0.0])) is None


@pytest.mark.parametrize("seed", range(4))
def test_cameras_that_are_all_a_little_off_are_no_other_depth_or_axes(tmp_path: Path, seed: int):
    trajectory = recorded("active_stereo")
    poses = trajectory.cam_to_world.copy()
    poses[..., :3, 3] += np.random.default_rng(seed).normal(scale=0.01, size=(poses.shape[-3], 3))

    found = explained(tmp_path, replace(trajectory, cam_to_world=poses))

    assert found is None or replace(found, pixel_shift=0.0) == CameraConvention()  # which is said to look alike
