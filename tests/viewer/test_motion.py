"""The ways of particles that a trained model moves."""

from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("viser")

from tests.released_demo import demo_model, make_demo_data
from vpd_lightning.viewer.opened_scene import open_scene
from vpd_lightning.viewer.session import Session


def test_the_ways_of_moving_particles_are_those_of_the_rollout(tmp_path: Path) -> None:
    model = demo_model()
    path = make_demo_data(tmp_path / "data") / "test" / "000000.h5"
    session = Session(open_scene(model.simulator, path, 0, model.input_views, "demo"))
    assert session.motion(2, 50) is None  # not simulated yet
    session.simulate(2)
    positions = torch.stack([state.positions[0] for state in session.now.states])
    moved = (positions.diff(dim=0).norm(dim=-1) > 0.002).any(dim=0) & session.now.states[2].mask[0]
    assert 100 < int(moved.sum()) < len(moved)
    ways, colors = session.motion(2, 10**6)
    assert np.array_equal(ways, positions[:, moved].numpy()) and colors.shape == (ways.shape[1], 3)
    assert session.motion(2, 5)[0].shape[1] <= 5
