"""The axes of the stability matrix, and which of its cases `make test` leaves to `make stability`."""

from collections import defaultdict
from pathlib import Path

import pytest
import torch

from tests.stability.covering import covering
from tests.stability.hard_scenes import MODES, SCENES, HardScene, Mode

FOLDER = Path(__file__).parent


@pytest.hookimpl(tryfirst=True)  # before -m looks at markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as exhaustive every case whose values meet, two by two, in other cases of the same file that are not.

    The test is one more factor: each of them sees every value of each of its parameters, and every two values that
    meet in the file meet in one of its tests.
    """
    cases_of: dict[str, list[pytest.Function]] = defaultdict(list)
    for item in items:
        if item.path.is_relative_to(FOLDER) and isinstance(item, pytest.Function) and hasattr(item, "callspec"):
            if item.get_closest_marker("exhaustive"):
                continue
            cases_of[str(item.path)].append(item)
    for cases in cases_of.values():
        values = [{name: repr(value) for name, value in case.callspec.params.items()} for case in cases]
        chosen = covering([{**of_case, "test": case.originalname} for of_case, case in zip(values, cases, strict=True)])
        for place, case in enumerate(cases):
            if place not in chosen:
                case.add_marker(pytest.mark.exhaustive)


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
