from dataclasses import asdict

import numpy as np
import pytest
import torch

from data_gen import mujoco_block
from data_gen.cameras import camera_intrinsics, camera_poses
from data_gen.mujoco_block.scene import initial_state
from data_gen.settings import differences, load_settings, preset_names
from tests.data_gen.blocks import small_scene
from vpd_lightning.data.ground_truth import GroundTruth
from vpd_lightning.data.schema import Trajectory
from vpd_lightning.errors import ConfigError
from vpd_lightning.geometry.rotations import rotation_matrix

VIEW_SIZE = {"camera.height": 48, "camera.width": 64}
TOLERANCE = 1e-4  # m; the bound. Float32 depth alone is good to 5e-7 m at 8 m


@pytest.fixture(scope="module")
def scene():
    return small_scene(**VIEW_SIZE, **{"camera.num_views": 4, "num_frames": 12, "frame_time": 0.1})


@pytest.fixture(scope="module")
def trajectory(scene):
    return scene.trajectory(seed=3, split="train", index=0, scene_hash="")


def unproject(trajectory: Trajectory, time: int, view: int) -> np.ndarray:
    """World points (height, width, 3) by loops over the definition: pixel centres at +0.5, OpenCV axes, z-depth."""
    depth, matrix = trajectory.depth[time, view].astype(np.float64), trajectory.intrinsics[view]
    points = np.zeros((*depth.shape, 3))
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            x = (column + 0.5 - matrix[0, 2]) / matrix[0, 0]
            y = (row + 0.5 - matrix[1, 2]) / matrix[1, 1]
            camera = depth[row, column] * np.array([x, y, 1.0])
            points[row, column] = trajectory.cam_to_world[view, :3, :3] @ camera + trajectory.cam_to_world[view, :3, 3]
    return points


def distance_to_box(points: np.ndarray, position: np.ndarray, rotation: np.ndarray, half: np.ndarray) -> np.ndarray:
    outside = np.abs((points - position) @ rotation) - half
    return np.abs(np.linalg.norm(np.maximum(outside, 0), axis=-1) + np.minimum(outside.max(axis=-1), 0))


def state_of(trajectory: Trajectory) -> GroundTruth:
    assert trajectory.state is not None
    return GroundTruth(**trajectory.state)


def rotations_of(state: GroundTruth) -> np.ndarray:
    return rotation_matrix(torch.from_numpy(state.quaternions)).numpy()


def check_depth(trajectory: Trajectory) -> None:
    state = state_of(trajectory)
    rotations, seen = rotations_of(state), 0
    for time in range(0, len(trajectory.depth), 3):
        for view in range(trajectory.depth.shape[1]):
            points, label = unproject(trajectory, time, view), state.segmentation[time, view]
            measured = trajectory.depth[time, view] > 0
            assert np.abs(points[measured & (label == 0)][:, 2]).max() < TOLERANCE
            block = points[label == 1]
            seen += len(block)
            if len(block):
                far = distance_to_box(block, state.positions[time, 0], rotations[time, 0], state.half_sizes[0])
                assert far.max() < TOLERANCE
    assert seen > 100


def test_raycast_depth_lies_on_floor_and_block(trajectory: Trajectory):
    check_depth(trajectory)


def test_block_has_the_colour_of_the_face_that_is_seen(scene, trajectory: Trajectory):
    """Most saturated pixel colours must be face colours up to their brightness."""
    state, faces = state_of(trajectory), np.asarray(scene.settings.block.face_colors)
    colors = trajectory.rgb[state.segmentation == 1].astype(float) / 255
    cosine = (colors @ faces.T) / np.linalg.norm(colors, axis=1)[:, None] / np.linalg.norm(faces, axis=1)

    assert np.mean(cosine.max(axis=1) > 0.999) > 0.5  # the rest are borders, averaged over 2 x 2 rays
    assert len(np.unique(cosine.argmax(axis=1))) >= 4


def test_velocities_are_in_the_world_frame(scene):
    """Between two near frames the pose changes by velocity times time, in flight."""
    fast = small_scene(**{"frame_time": 0.0025, "num_frames": 3})
    state = state_of(fast.trajectory(seed=1, split="train", index=0, scene_hash=""))
    step = fast.settings.frame_time
    moved = (state.positions[1:] - state.positions[:-1]) / step
    np.testing.assert_allclose(moved, state.linear_velocities[1:], atol=1e-6)  # semi-implicit Euler: v after the step
    rotations = rotations_of(state)
    turn = rotations[1:] @ np.swapaxes(rotations[:-1], -1, -2)
    rate = np.stack([turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]], -1) / step
    np.testing.assert_allclose(rate, state.angular_velocities[1:], atol=2e-3 * np.abs(rate).max())


@pytest.mark.parametrize("preset", ["demo", "tiny"])
def test_block_flies_for_four_frames_and_lands_inside(preset: str):
    import mujoco

    settings = load_settings(mujoco_block.Settings, "mujoco_block", preset, {})
    scene = mujoco_block.Scene(settings, "raycast")
    inside = 0
    for index in range(30):
        mujoco.mj_resetData(scene.model, scene.data)
        scene.data.qpos[:], scene.data.qvel[:] = initial_state(settings, 0, "train", index)
        for _ in range(3):
            mujoco.mj_step(scene.model, scene.data, settings.substeps)
            assert scene.data.ncon == 0
        mujoco.mj_step(scene.model, scene.data, 20 * settings.substeps)
        inside += bool((np.abs(scene.data.qpos[:2]) < 1.0).all())

    assert inside >= 27


def test_cameras_look_at_the_target_and_are_level(scene):
    camera = scene.settings.camera
    for matrix, pose in zip(camera_intrinsics(camera), camera_poses(camera), strict=True):
        seen = matrix @ np.linalg.inv(pose)[:3] @ np.append(camera.target, 1.0)
        np.testing.assert_allclose(seen[:2] / seen[2], [camera.width / 2, camera.height / 2], atol=1e-9)
        assert seen[2] == pytest.approx(camera.radius)
        assert abs(pose[2, 0]) < 1e-12 and pose[2, 1] < 0  # x level, y down
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


def test_paper_preset_has_the_papers_numbers():
    settings = load_settings(mujoco_block.Settings, "mujoco_block", "paper", {})

    assert (settings.splits.train, settings.splits.validation, settings.splits.test) == (256, 16, 16)
    assert (settings.num_frames, settings.camera.num_views) == (64, 16)
    assert (settings.camera.height, settings.camera.width) == (128, 128)
    assert (settings.near, settings.far) == (0.3, 5.0)
    assert (settings.workspace_min, settings.workspace_max) == ([-1.0] * 3, [1.0] * 3)


def test_there_are_four_presets():
    assert preset_names("mujoco_block") == ["demo", "paper", "small", "tiny"]


def test_tiny_preset_is_the_demos_with_fewer_and_shorter_trajectories():
    demo, tiny = (asdict(load_settings(mujoco_block.Settings, "mujoco_block", name, {})) for name in ("demo", "tiny"))

    changed = {line.split(":")[0] for line in differences(demo, tiny)}
    assert changed == {"splits.train", "splits.validation", "splits.test", "num_frames"}


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("block.sid", 0.2, "did you mean 'block.side'"),
        ("camera", 3, "group of settings"),
        ("block.side", "big", "block.side"),
        ("block.side", -1.0, "block.side is -1.0; allowed"),
        ("frame_time", 0.0123, "multiple of timestep"),
        ("near", 9.0, "0 < near < far"),
        ("camera.height", 4, "8 to 2048"),
        ("renderer", "vulkan", "auto, egl, osmesa, blender, raycast"),
        ("toss.position_min", [0.0, 0.0, 0.1], "cannot touch the floor"),
        ("splits.train", -3, "splits.train is -3"),
        ("storage.compression", "rar", "gzip, lzf, none"),
    ],
)
def test_wrong_settings_are_refused_by_name(key: str, value: object, message: str):
    with pytest.raises(ConfigError, match=message):
        load_settings(mujoco_block.Settings, "mujoco_block", "tiny", {key: value})
