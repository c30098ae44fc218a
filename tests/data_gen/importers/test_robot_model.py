"""Points on a robot's links follow its joints as its own kinematics, written out by hand, say."""

from pathlib import Path

import numpy as np
import pytest

from data_gen.importers.robot_model import RobotModel, load_robot
from vpd_lightning.errors import ConfigError, DataError

UPPER, FORE = 0.3, 0.2  # m
ARM = f"""
<mujoco model="arm">
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="base">
      <geom type="cylinder" size="0.05 0.02"/>
      <body name="upper" pos="0 0 0.04">
        <joint name="shoulder" type="hinge" axis="0 0 1"/>
        <geom type="box" size="{UPPER / 2} 0.02 0.01" pos="{UPPER / 2} 0 0"/>
        <body name="fore" pos="{UPPER} 0 0">
          <joint name="elbow" type="hinge" axis="0 0 1"/>
          <geom type="capsule" size="0.015" fromto="0 0 0 {FORE} 0 0"/>
          <body name="finger" pos="{FORE} 0 0">
            <joint name="slide" type="slide" axis="1 0 0"/>
            <geom type="sphere" size="0.02"/>
            <geom type="box" size="0.5 0.5 0.5" group="3"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>"""
URDF = """
<robot name="arm">
  <link name="base"/>
  <link name="tip"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>
    <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 0 1"/>
    <origin xyz="0.5 0 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
</robot>"""


@pytest.fixture
def arm(tmp_path: Path) -> RobotModel:
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    return load_robot(path, num_points=2000)


def test_links_go_where_the_joints_put_them(arm: RobotModel) -> None:
    positions = np.array([[30.0, -50.0, 9.0, 0.01], [90.0, 0.0, 9.0, 0.0]])
    base = np.eye(4)
    base[:3, 3] = [1.0, 2.0, 0.5]
    poses = arm.poses(["shoulder", "elbow", None, "slide"], positions, "deg", base)
    assert arm.link_names == ["base", "upper", "fore", "finger"]
    for frame, (shoulder, elbow, _, slide) in enumerate(positions):
        first, second = np.radians(shoulder), np.radians(shoulder + elbow)
        along, across = np.array([np.cos(first), np.sin(first), 0]), np.array([np.cos(second), np.sin(second), 0])
        at_elbow = [1.0, 2.0, 0.54] + UPPER * along
        np.testing.assert_allclose(poses[frame, 2, :3, 3], at_elbow, atol=1e-12)
        np.testing.assert_allclose(poses[frame, 3, :3, 3], at_elbow + (FORE + slide) * across, atol=1e-12)
        np.testing.assert_allclose(poses[frame, 3, :3, 0], across, atol=1e-12)


def test_points_lie_on_the_shapes_that_are_seen_and_look_outward(arm: RobotModel) -> None:
    away = {
        "base": lambda p: np.maximum(np.hypot(p[:, 0], p[:, 1]) - 0.05, np.abs(p[:, 2]) - 0.02),
        "upper": lambda p: (np.abs(p - [UPPER / 2, 0, 0]) - [UPPER / 2, 0.02, 0.01]).max(axis=1),
        "fore": lambda p: np.linalg.norm(p - np.clip(p, [0, 0, 0], [FORE, 0, 0]), axis=1) - 0.015,
        "finger": lambda p: np.linalg.norm(p, axis=1) - 0.02,  # and not the box that only collides
    }
    for group, name in enumerate(arm.link_names):
        chosen = arm.groups == group
        assert np.abs(away[name](arm.points[chosen])).max() < 1e-3, name  # round shapes are faceted
        assert (away[name](arm.points[chosen] + 0.003 * arm.normals[chosen]) > 1e-3).all(), name
    areas = np.array([2 * np.pi * 0.05 * (0.04 + 0.05), 8 * (0.15 * 0.02 + 0.15 * 0.01 + 0.02 * 0.01),
                      2 * np.pi * 0.015 * (FORE + 0.03), 4 * np.pi * 0.02**2])  # fmt: skip
    np.testing.assert_allclose(np.bincount(arm.groups) / len(arm.groups), areas / areas.sum(), atol=0.01)


def test_motion_carries_points_and_normals(arm: RobotModel) -> None:
    poses = arm.poses(["shoulder"], np.array([[0.0], [0.7]]), "rad", np.eye(4))
    motion = arm.motion(poses, poses)
    for particle in (0, len(arm.points) // 2, len(arm.points) - 1):
        pose = poses[1, arm.groups[particle]]
        np.testing.assert_allclose(motion.points[1, particle], (pose @ [*arm.points[particle], 1])[:3], atol=1e-6)
        np.testing.assert_allclose(motion.normals[1, particle], pose[:3, :3] @ arm.normals[particle], atol=1e-6)
    np.testing.assert_array_equal(motion.groups, arm.groups)


def test_urdf_is_read(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    robot = load_robot(path, num_points=100)
    poses = robot.poses(["turn"], np.array([[np.pi / 2]]), "rad", np.eye(4))
    assert robot.link_names == ["tip"]
    np.testing.assert_allclose(poses[0, 0, :3, 3], [0.5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(poses[0, 0, :3, 0], [0, 1, 0], atol=1e-12)


def test_mistakes_are_named(arm: RobotModel, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no joint 'elbo'.*did you mean 'elbow'"):
        arm.poses(["elbo"], np.zeros((1, 1)), "rad", np.eye(4))
    with pytest.raises(DataError, match=r"shape \(1, 2\); 1 joints"):
        arm.poses(["elbow"], np.zeros((1, 2)), "rad", np.eye(4))
    with pytest.raises(DataError, match="not finite"):
        arm.poses(["elbow"], np.full((1, 1), np.nan), "rad", np.eye(4))
    with pytest.raises(ConfigError, match="there is no such file"):
        load_robot(tmp_path / "none.xml", 10)
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody><geom/></mujoco>")
    with pytest.raises(ConfigError, match="cannot be read as MJCF or URDF"):
        load_robot(broken, 10)
    empty = tmp_path / "empty.xml"
    empty.write_text('<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>')
    with pytest.raises(ConfigError, match="has no shapes"):
        load_robot(empty, 10)
