import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from data_gen import gl_backend
from tests.data_gen.blocks import SMALL, small_scene
from tests.data_gen.test_mujoco_block import check_depth
from vpd_lightning.data.ground_truth import read_state
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.schema import Trajectory
from vpd_lightning.errors import RenderingBackendError

ROOT = Path(__file__).resolve().parents[2]


def read(path: Path) -> Trajectory:
    state = read_state(path)
    with TrajectoryReader(path) as reader:
        intrinsics, cam_to_world = reader.cameras([0])
        return Trajectory(
            rgb=reader.rgb(),
            depth=reader.depth(),
            intrinsics=intrinsics[0],
            cam_to_world=cam_to_world[0],
            frame_time=reader.frame_time,
            near=reader.near,
            far=reader.far,
            workspace_min=reader.workspace_min,
            workspace_max=reader.workspace_max,
            state=vars(state),
        )


@pytest.mark.gl
@pytest.mark.slow
def test_gl_pictures_are_exact_in_depth_and_near_to_the_ray_cast_ones(tmp_path: Path):
    """GL runs in worker processes, because the backend must be chosen before MuJoCo is imported."""
    overrides = {**SMALL, "camera.height": 64, "camera.width": 64, "num_frames": 4, "frame_time": 0.1}
    words = [f"{key}={value}" for key, value in overrides.items()]
    command = [sys.executable, "-m", "vpd_lightning.commands.data", "generate", "scene=mujoco_block", "preset=tiny"]
    environment = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}
    environment.pop("MUJOCO_GL", None)
    subprocess.run([*command, f"out={tmp_path}", "renderer=auto", "workers=1", *words], check=True, env=environment)

    drawn = read(tmp_path / "train" / "000000.h5")
    cast = small_scene(**overrides).trajectory(seed=0, split="train", index=0, scene_hash="")
    assert cast.state is not None and drawn.state is not None
    check_depth(drawn)
    same = drawn.state["segmentation"] == cast.state["segmentation"]
    assert same.mean() > 0.999  # pixels whose centre lies on an edge may differ
    assert np.abs(drawn.depth - cast.depth)[same].max() < 1e-3
    # Same faces, floor pattern, light and shadow; the light is softer and filtering differs.
    assert np.abs(drawn.rgb.astype(int) - cast.rgb).mean() < 3.0


def test_machine_without_gl_gets_the_packages_and_the_way_around(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(gl_backend, "why_not", lambda backend: "no such library")

    with pytest.raises(RenderingBackendError) as caught:
        gl_backend.choose_backend("auto")

    message = str(caught.value)
    assert "libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0 libgl1" in message
    assert "libosmesa6" in message and "renderer=raycast" in message
    assert "egl: no such library; osmesa: no such library" in message
    assert len(message.splitlines()) <= 5
    assert caught.value.exit_code == 3


def test_auto_prefers_egl_unless_the_user_set_another(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(gl_backend, "why_not", lambda backend: None)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert gl_backend.choose_backend("auto") == "egl"
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert gl_backend.choose_backend("auto") == "osmesa"
    assert gl_backend.choose_backend("egl") == "egl"


def test_backend_that_cannot_start_gives_a_reason():
    assert gl_backend.why_not("no-such-backend")
