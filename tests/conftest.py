"""What every test may rely on: a fixed seed, one thread per process, markers that skip what the machine lacks."""

import gc
import importlib.util
import os
import random
from collections.abc import Callable

import numpy as np
import pytest
import torch

from tests import cpu_seconds, fork_server, shape_checks
from tests.cpu_seconds import pytest_addoption  # noqa: F401

shape_checks.install()  # before a module of ours is imported

# Tests run in several processes; more threads than cores makes all of them slower. Set before OpenCV or HDF5 load.
os.environ.setdefault("OMP_NUM_THREADS", "1")
torch.set_num_threads(1)

# The shape checks look for other bytecode while a module of ours is imported, also for what that module imports: these
# packages would be compiled anew in each test process, which takes ten seconds.
IMPORTED_BEFORE_OURS = ("lightning.pytorch", "torch_geometric", "numba", "scipy.spatial")


def pytest_configure(config: pytest.Config) -> None:
    cpu_seconds.pytest_configure(config)
    if config.getoption("numprocesses", None) and not hasattr(config, "workerinput"):
        return  # this process hands tests out and runs none
    for name in IMPORTED_BEFORE_OURS:
        if importlib.util.find_spec(name.partition(".")[0]) is not None:
            importlib.import_module(name)


def pytest_collection_finish() -> None:
    """Spare the garbage collector the half a million objects that stay, and let it look at the others less often."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


def _gl_works() -> bool:
    if importlib.util.find_spec("data_gen.gl_backend") is None:
        return False
    from data_gen.gl_backend import working_backend

    return working_backend() is not None


# marker -> (is it there?, what to say when it is not)
REQUIREMENTS: dict[str, tuple[Callable[[], bool], str]] = {
    "gpu": (lambda: torch.cuda.is_available(), "needs a CUDA device"),
    "cluster": (lambda: importlib.util.find_spec("torch_cluster") is not None, "needs torch-cluster: make cluster"),
    "gl": (_gl_works, "needs EGL or OSMesa"),
}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files with slow tests first, so that no process is left alone with a long one at the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def pytest_sessionfinish() -> None:
    fork_server.stop()


@pytest.fixture(autouse=True)
def _requirements(request: pytest.FixtureRequest) -> None:
    for marker, (is_there, reason) in REQUIREMENTS.items():
        if request.node.get_closest_marker(marker) and not is_there():
            pytest.skip(reason)


@pytest.fixture(autouse=True)
def _seed() -> None:
    shape_checks.start_again()
    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Every device that this machine has, one after the other."""
    return torch.device(request.param)
