"""One trajectory of every MOVi-like scene as the paper has it: generated, validated, complete."""

from pathlib import Path

import numpy as np
import pytest

from data_gen.generate import generate
from data_gen.inspection.validate import validate_dataset
from tests.data_gen.test_gl import read

ONE = {"splits.train": 1, "splits.validation": 0, "splits.test": 0}


@pytest.mark.gl
@pytest.mark.slow
@pytest.mark.parametrize(
    "scene",
    [
        "movi_a",
        *(pytest.param(f"movi_{name}", marks=pytest.mark.exhaustive) for name in ("b", "c", "a_high", "c_high")),
    ],
)
def test_full_size_trajectory_is_valid(scene: str, tmp_path: Path):
    folder = generate(scene, "paper", tmp_path / scene, seed=1, workers=1, overrides=ONE)

    # Among its checks: fewer than 1 % of the points lie in front of what another view measured.
    assert validate_dataset(folder) == []
    trajectory = read(folder / "train" / "000000.h5")
    state = trajectory.state
    assert state is not None
    assert trajectory.rgb.shape == (96, 9, 128, 128, 3)
    assert (trajectory.depth > 0).all()
    assert state["positions"].shape == (96, 3, 3)
    assert all(np.isfinite(values).all() for values in state.values() if values is not None)  # no soft bodies
    assert set(np.unique(state["segmentation"])) == {0, 1, 2, 3}  # every object is seen
    if scene.endswith("high"):
        assert trajectory.depth.max() < trajectory.far  # no dome
    else:
        assert 45.0 < trajectory.depth.max() < 65.0  # the dome, from the farthest camera
