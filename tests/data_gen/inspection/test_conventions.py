"""Wrong conventions are found and named, and correct data are left in peace, on scenes known in closed form."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_gen.inspection.fault import Fault
from data_gen.inspection.validate import check_dataset, convention_errors, validate_dataset
from tests.data.analytic_scene import known_trajectory
from tests.data_gen.inspection.mistakes import (
    Change,
    as_distance,
    chain,
    converted_twice,
    inverted,
    noisy,
    opengl,
    positions_in_millimetres,
    scaled,
    shifted,
    turned_back,
    whole_millimetres,
    with_holes,
)
from vpd_lightning.data.schema import Trajectory, write_trajectory

GL_AXES = "the camera axes are OpenGL's (y up, z back)"
DISTANCE = "depth is the distance to the camera centre: divide"
MILLIMETRES = "depth is in millimetres: divide it by 1000"
ADD_HALF, TAKE_HALF = "add 0.5 to cx and cy", "subtract 0.5 from cx and cy"

MISTAKES: dict[str, tuple[Change, list[str]]] = {
    "opengl": (opengl, [GL_AXES]),
    "inverted": (inverted, ["cam_to_world is world_to_cam: invert it"]),
    "inverted opengl": (chain(opengl, inverted), ["cam_to_world is world_to_cam with OpenGL axes"]),
    "rotation transposed": (turned_back, ["the rotation in cam_to_world is world_to_cam's"]),
    "distance": (as_distance, [DISTANCE]),
    "converted twice": (converted_twice, ["divided by the length of the ray: multiply"]),
    "millimetres": (scaled(1000), [MILLIMETRES]),
    "a thousandth": (scaled(1 / 1000), ["multiply it by 1000"]),
    "positions in millimetres": (positions_in_millimetres, ["positions in cam_to_world are in millimetres"]),
    "half a pixel less": (shifted(-0.5), [ADD_HALF]),
    "half a pixel more": (shifted(0.5), [TAKE_HALF]),
    "opengl, distance": (chain(opengl, as_distance), [GL_AXES, DISTANCE]),
    "opengl, millimetres": (chain(opengl, scaled(1000)), [GL_AXES, MILLIMETRES]),
    "distance, half a pixel": (chain(as_distance, shifted(-0.5)), [DISTANCE, ADD_HALF]),
    "opengl, distance, half a pixel": (chain(opengl, as_distance, shifted(0.5)), [GL_AXES, DISTANCE, TAKE_HALF]),
    "whole millimetres, half a pixel": (chain(whole_millimetres, shifted(-0.5)), [ADD_HALF]),
    "noise, opengl": (chain(noisy, opengl), [GL_AXES]),
    "noise, distance": (chain(noisy, as_distance), [DISTANCE]),
}


def check(folder: Path, trajectory: Trajectory) -> list[Fault]:
    write_trajectory(folder / "a.h5", trajectory)
    return validate_dataset(folder / "a.h5")


def suggestion(faults: list[Fault]) -> str:
    messages = [fault.message for fault in faults if fault.name == "views_disagree" and fault.is_error]
    assert len(messages) == 1
    return messages[0].partition(" if ")[2]


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake_is_named_from_several_views(tmp_path: Path, mistake: str):
    change, texts = MISTAKES[mistake]
    named = suggestion(check(tmp_path, change(known_trajectory(seed=1))))

    assert all(text in named for text in texts)
    assert named.count("; and ") == len(texts) - 1


@pytest.mark.parametrize(
    "mistake",
    ["opengl", "inverted", "distance", "converted twice", "millimetres", "half a pixel less", "half a pixel more"],
)
def test_mistake_is_named_from_one_moving_camera(tmp_path: Path, mistake: str):
    change, texts = MISTAKES[mistake]
    named = suggestion(check(tmp_path, change(known_trajectory(seed=2, num_views=1, num_frames=8, is_moving=True))))

    assert all(text in named for text in texts)
    assert named.count("; and ") == len(texts) - 1


def test_two_views_are_enough_for_half_a_pixel(tmp_path: Path):
    trajectory = known_trajectory(seed=3, num_views=2, num_frames=1)

    assert check(tmp_path, trajectory) == []
    assert ADD_HALF in suggestion(check(tmp_path, shifted(-0.5)(trajectory)))


SENSORS: dict[str, Change] = {
    "exact": lambda trajectory: trajectory,
    "noise": noisy,
    "whole millimetres": whole_millimetres,
    "holes": with_holes,
    "all of it": chain(noisy, whole_millimetres, with_holes),
}


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("seed", [0, 1])
def test_correct_data_have_no_fault(tmp_path: Path, sensor: str, seed: int):
    faults = check(tmp_path, SENSORS[sensor](known_trajectory(seed=seed)))

    assert [fault for fault in faults if fault.is_error] == []
    if sensor in ("exact", "holes", "whole millimetres"):
        assert faults == []


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("seeds", [range(20, 22), pytest.param(range(22, 35), marks=pytest.mark.exhaustive)])
def test_correct_data_of_many_scenes_have_no_fault(tmp_path: Path, sensor: str, seeds: range):
    for seed in seeds:
        shape = {"num_views": 2 + seed % 4} if seed % 3 else {"num_views": 1, "num_frames": 9, "is_moving": True}
        faults = check(tmp_path, SENSORS[sensor](known_trajectory(seed=seed, **shape)))

        assert [fault for fault in faults if fault.is_error] == [], seed


def test_exact_views_agree_to_rounding_and_wrong_conventions_do_not(tmp_path: Path):
    write_trajectory(tmp_path / "a.h5", known_trajectory(seed=4))
    errors = convention_errors(tmp_path / "a.h5")

    assert errors["as stored"] < 1e-7  # float32 depth
    assert sorted(errors.values())[1] > 1e-4


def test_noise_is_said_to_hide_half_a_pixel(tmp_path: Path):
    (remark,) = [fault for fault in check(tmp_path, noisy(known_trajectory(seed=5))) if fault.name == "cannot_tell"]

    assert not remark.is_error
    assert "noise" in remark.message and "principal point" in remark.message
    assert "OpenGL" not in remark.message


def test_single_static_camera_is_said_to_tell_nothing(tmp_path: Path):
    for change in (SENSORS["exact"], opengl, as_distance, shifted(-0.5)):
        trajectory = change(known_trajectory(seed=0, num_views=1))
        faults = [fault for fault in check(tmp_path, trajectory) if fault.name != "empty_workspace"]

        assert [(fault.name, fault.is_error) for fault in faults] == [("cannot_tell", False)]
        assert "one camera that stands still" in faults[0].message


def test_camera_that_hardly_moves_is_said_to_tell_nothing_about_axes(tmp_path: Path):
    trajectory = known_trajectory(seed=0, num_views=1, num_frames=5)
    poses = np.repeat(trajectory.cam_to_world[None], 5, axis=0)
    poses[:, 0, :3, 3] += 1e-6 * np.arange(5)[:, None]
    (remark,) = check(tmp_path, replace(trajectory, cam_to_world=poses))

    assert (remark.name, remark.is_error) == ("cannot_tell", False)
    assert "OpenGL" in remark.message and "principal point" in remark.message


def test_views_side_by_side_cannot_tell_opengl_axes_and_say_so(tmp_path: Path):
    trajectory = known_trajectory(seed=0, num_views=2)
    poses = trajectory.cam_to_world.copy()
    poses[1] = poses[0]
    faults = check(tmp_path, replace(trajectory, cam_to_world=poses, depth=trajectory.depth[:, [0, 0]].copy()))

    assert [(fault.name, fault.is_error) for fault in faults] == [("cannot_tell", False)]
    assert "OpenGL" in faults[0].message


def test_views_without_shared_points_are_no_fault(tmp_path: Path):
    trajectory = known_trajectory(seed=0, num_views=2)
    depth = trajectory.depth.copy()
    depth[:, 0, :, 4:], depth[:, 1, :, :-4] = 0, 0
    faults = check(tmp_path, replace(trajectory, depth=depth))

    assert not [fault for fault in faults if fault.is_error]


def test_scene_wholly_in_millimetres_is_named_though_views_agree(tmp_path: Path):
    faults = check(tmp_path, chain(scaled(1000), positions_in_millimetres)(known_trajectory(seed=0)))

    assert [fault.name for fault in faults if fault.is_error] == ["empty_workspace"]
    assert MILLIMETRES in faults[0].message and "positions in cam_to_world" in faults[0].message


def test_uncalibrated_camera_is_a_fault_without_a_suggestion(tmp_path: Path):
    trajectory = known_trajectory(seed=1)
    poses = trajectory.cam_to_world.copy()
    poses[1, :3, 3] += [0.3, 0.2, 0.1]
    poses[2, :3, 3] -= [0.2, 0.3, 0.2]
    faults = [fault for fault in check(tmp_path, replace(trajectory, cam_to_world=poses)) if fault.is_error]

    assert faults[0].name == "views_disagree" and "no other convention explains it" in faults[0].message


def test_summary_is_one_line_with_distance_and_share(tmp_path: Path):
    write_trajectory(tmp_path / "a.h5", noisy(known_trajectory(seed=1)))
    report = check_dataset(tmp_path / "a.h5")

    assert report.is_valid
    assert len(report.summary.splitlines()) == 1
    assert "median cross-view distance 0.4" in report.summary and "free-space violations" in report.summary
