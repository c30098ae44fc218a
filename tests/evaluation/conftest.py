"""The data set and protocol that the tests of the evaluation share."""

from pathlib import Path
from typing import Any

import pytest

from tests.evaluation.tossed_box import write_tossed_boxes
from vpd_lightning.data.manifest import Manifest, load_manifest
from vpd_lightning.evaluation.protocol import Protocol


@pytest.fixture(scope="session")
def manifest(tmp_path_factory: pytest.TempPathFactory) -> Manifest:
    return load_manifest(write_tossed_boxes(tmp_path_factory.mktemp("tossed_boxes")))


def protocol_with(**changes: Any) -> Protocol:
    values: dict[str, Any] = {
        "split": "test",
        "start_frames": (0, 2),
        "num_steps": 4,
        "num_trajectories": None,
        "num_long_steps": 20,
        "long_start_frame": 0,
        "moving_threshold": 0.1,
        "min_moving_pixels": 10,
        "body_margin": 0.02,
        "num_chamfer_points": 2000,
        "num_bootstrap": 100,
    }
    return Protocol(**{**values, **changes})


@pytest.fixture
def protocol() -> Protocol:
    return protocol_with()


@pytest.fixture(scope="session")
def test_paths(manifest: Manifest) -> list[Path]:
    return manifest.split("test")
