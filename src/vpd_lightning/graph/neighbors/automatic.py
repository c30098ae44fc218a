"""What ``auto`` means: a fixed rule, never a timing, so that a run repeats bit for bit on the same machine.

The rule follows from measurements in ``automatic.json`` beside this file, which ``python -m benchmarks.neighbor_table``
writes; a test checks that nothing the rule chooses is far from the fastest of its row. The entry for CUDA is by design
and has not been measured: brute force compares all pairs and waits for the host, the Triton kernel does neither.
"""

import functools
import importlib.util
import json
from importlib import resources
from typing import Any

import torch

_COMPILED_FROM = 64
"""On a CPU compiled loops or a tree pay from this many points on; below, brute force is as fast and imports nothing."""

_COMPILED_FROM_RADIUS_POINTS = 512
"""The same for the radius search, which brute force does in one pass."""

_TREE_FROM_RADIUS_POINTS = 4096
"""SciPy's radius search makes Python lists, so without numba brute force stays ahead for longer."""


def automatic_backend(device: torch.device, num_points: int, *, is_radius: bool = False, is_graph: bool = False) -> str:
    """Return the backend that ``auto`` means for so many points on this device, from what is installed.

    ``is_graph`` marks the searches of the dynamics' graph, which take torch-cluster where it is installed.
    """
    if is_graph and _is_installed("torch_cluster"):
        return "torch_cluster"
    if device.type == "cuda":
        return "triton" if not is_radius and _is_installed("triton") else "torch"
    if device.type != "cpu" or num_points < (_COMPILED_FROM_RADIUS_POINTS if is_radius else _COMPILED_FROM):
        return "torch"
    if _is_installed("numba"):
        return "numba"
    return "torch" if is_radius and num_points < _TREE_FROM_RADIUS_POINTS else "scipy"


def measurements() -> list[dict[str, Any]]:
    """Return the table behind the rule: device, search, points, queries, k and the seconds of each backend."""
    text = resources.files(__package__).joinpath("automatic.json").read_text(encoding="utf-8")
    return json.loads(text)["rows"]


@functools.cache
def _is_installed(package: str) -> bool:
    return importlib.util.find_spec(package) is not None
