"""The demo's pictures drawn again, from its cameras and from cameras beside them."""

import numpy as np

from data_gen.cameras import camera_poses
from data_gen.mujoco_block.scene import MujocoBlockScene
from data_gen.mujoco_block.settings import MujocoBlockSettings
from data_gen.settings import load_settings
from docs.results.studies.shifted_camera import TruePictures, shifted

SMALL = {"num_frames": 3, "camera.height": 24, "camera.width": 24}


def test_the_recorded_pose_gives_the_recorded_pictures_and_a_shift_gives_others() -> None:
    settings = load_settings(MujocoBlockSettings, "mujoco_block", "demo", SMALL)
    recorded = MujocoBlockScene(settings, "raycast").trajectory(0, "train", 0, "hash")
    poses = camera_poses(settings.camera)
    pose = recorded.state["positions"][2, 0], recorded.state["quaternions"][2, 0]
    own, beside = (TruePictures(settings, poses), TruePictures(settings, shifted(poses, 0.05)))
    np.testing.assert_array_equal(own.draw(*pose), recorded.rgb[2])
    assert (beside.draw(*pose) != recorded.rgb[2]).mean() > 0.05
    step = beside.cameras.cam_to_world - own.cameras.cam_to_world
    np.testing.assert_allclose(step[:, :3, 3].norm(dim=-1), 0.05, rtol=1e-5)
    np.testing.assert_allclose(step[:, :3, :3], 0, atol=1e-7)
