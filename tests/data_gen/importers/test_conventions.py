import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_gen.importers.conventions import (
    UP_CHOICES,
    checked_pose,
    distance_to_z,
    invert_pose,
    opengl_to_opencv,
    pose_matrix,
    rotation_from_quaternion,
    shift_principal_point,
    world_rotation,
)
from data_gen.importers.lens import distort, undistort
from tests.data_gen.importers import known_scene
from vpd_lightning.errors import DataError


@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
def test_quaternions_agree_with_scipy(order: str):
    values = np.random.default_rng(0).normal(size=(20, 4))
    expected = Rotation.from_quat(np.roll(values, -1, axis=1) if order == "wxyz" else values).as_matrix()

    assert np.abs(rotation_from_quaternion(values, order) - expected).max() < 1e-14


def test_opengl_axes_look_the_other_way_and_twice_is_nothing():
    pose = known_scene.cameras(1)[1]

    turned = opengl_to_opencv(pose)
    assert (turned[0, :3, 2] == -pose[0, :3, 2]).all() and (turned[0, :3, 1] == -pose[0, :3, 1]).all()
    assert (turned[0, :3, [0, 3]] == pose[0, :3, [0, 3]]).all()
    assert (opengl_to_opencv(turned) == pose).all()


def test_inverse_of_a_pose():
    poses = known_scene.cameras(4)[1]

    assert np.abs(invert_pose(poses) @ poses - np.eye(4)).max() < 1e-14


@pytest.mark.parametrize("up", UP_CHOICES)
def test_the_named_axis_becomes_z_by_exact_quarter_turns(up: str):
    axis = np.zeros(4)
    axis["xyz".index(up[-1])] = -1.0 if up[0] == "-" else 1.0
    turn = world_rotation(up)

    assert (turn @ axis == [0, 0, 1, 0]).all()
    assert np.linalg.det(turn) == 1.0
    assert set(np.unique(turn)) <= {-1.0, 0.0, 1.0}


@pytest.mark.parametrize("lens", [None, [-0.2, 0.05, 0.002, -0.001, 0.0], [0.1, 0.02, 0, 0, 0.01, 0.05, 0.01, 0.002]])
def test_distances_become_depth_through_any_lens(lens: list[float] | None):
    intrinsics, poses = (x[0] for x in known_scene.cameras(1))
    distortion = None if lens is None else np.array(lens)
    picture = known_scene.render(intrinsics, poses, 48, 64, 0.0, distortion)

    depth = distance_to_z(picture.distance, intrinsics, distortion)

    assert np.abs(depth - picture.depth).max() < 5e-7  # float32 at 5 m
    assert np.abs(distance_to_z(picture.distance, shift_principal_point(intrinsics, 0.5)) - picture.depth).max() > 1e-3


def test_lens_model_is_inverted_where_it_can_be():
    lens = np.array([-0.25, 0.06, 0.001, 0.002, 0.0])
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 30), np.linspace(-0.5, 0.5, 20))
    back = undistort(*distort(x, y, lens), lens)
    assert max(np.abs(back[0] - x).max(), np.abs(back[1] - y).max()) < 1e-10

    folded = undistort(np.array([0.0, 5.0]), np.zeros(2), np.array([-0.5, 0.0, 0.0, 0.0, 0.0]))[0]
    assert folded[0] == 0.0 and np.isnan(folded[1])


def test_poses_of_float32_files_pass_and_others_do_not():
    pose = known_scene.cameras(1)[1][0]
    assert (checked_pose(pose[:3].astype(np.float32), "p") == np.vstack([pose[:3].astype(np.float32), pose[3]])).all()
    assert (pose_matrix(pose[:3, :3], pose[:3, 3]) == pose).all()
    for bad, message in (
        (pose[:2], "shape"),
        (pose * 2, "0 0 0 1"),
        ("pose", "not a matrix"),
        ([[1], [2, 3]], "not a"),
    ):
        with pytest.raises(DataError, match=message):
            checked_pose(bad, "p")
