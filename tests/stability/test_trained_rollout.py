"""The released graph network of VPD, rolled out 500 steps, where 32 are judged: whatever it draws, it is finite."""

from pathlib import Path

import pytest
import torch

from tests.stability.hard_scenes import MODES, Mode
from vpd_lightning.data.clip import read_clip
from vpd_lightning.evaluation.motion import trajectory_of
from vpd_lightning.evaluation.prediction import encode_clip
from vpd_lightning.loading import load_model

RELEASED = Path(__file__).parents[2] / "released" / "mujoco_block_vpd"
NUM_STEPS = 500
MAX_SPEED = 0.1
"""Metres a step, of any particle. Outputs that run away saturate the tanh, which allows 0.17 (0.1 along each axis)."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from data_gen.generate import generate

    folder = tmp_path_factory.mktemp("tiny") / "data"
    generate(scene="mujoco_block", preset="tiny", out=folder, seed=0)
    return sorted((folder / "test").glob("*.h5"))[0]


@pytest.mark.exhaustive
@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_five_hundred_steps_stay_finite_and_do_not_speed_up(recording: Path, mode: Mode) -> None:
    model = load_model(RELEASED)
    simulator = model.simulator.to(mode.dtype)
    clip = read_clip(recording, 0, 0, 1)
    with torch.no_grad(), mode.context(torch.device("cpu")):
        scene = encode_clip(simulator, clip, model.input_views)
        positions = trajectory_of(scene.current, simulator.rollout(scene, NUM_STEPS))
    assert positions.shape[0] == NUM_STEPS + 1
    assert torch.isfinite(positions).all()
    speed = (positions[1:] - positions[:-1]).norm(dim=-1).amax(-1)
    assert speed.max() < MAX_SPEED
