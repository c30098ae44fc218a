"""The axes of the stability matrix."""

import pytest
import torch

from tests.stability.hard_scenes import MODES, SCENES, HardScene, Mode


@pytest.fixture(params=MODES, ids=lambda mode: mode.name)
def mode(request: pytest.FixtureRequest) -> Mode:
    """float32, float32 under bfloat16 autocast, and float64."""
    return request.param


@pytest.fixture(params=SCENES)
def scene(request: pytest.FixtureRequest) -> HardScene:
    """Every hard point set, in float64."""
    return SCENES[request.param]()


@pytest.fixture(params=["cpu", *(["cuda"] if torch.cuda.is_available() else [])])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Every device that is here; of thousands of cases none is listed as skipped for a GPU that is not."""
    return torch.device(request.param)
