"""Which routes of a registry run on this machine, so that the matrix grows with the registries."""

import importlib.util
import os
from typing import Any

import pytest
import torch

IS_INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
"""Triton decides when it is imported: ``test_interpreter_stability.py`` runs files in a process of their own."""

_PACKAGES = ("scipy", "torch_cluster", "numba", "triton")
_CPU_ONLY = ("scipy", "numba")


def routes(*names: str) -> list[Any]:
    """Return pairs of a route and a device to try, as pytest's parameters.

    In Triton's interpreter there is nothing but Triton on the CPU, for everything else is tried without it.
    """
    if IS_INTERPRETED:
        return [pytest.param((name, "cpu"), id=f"{name}-cpu") for name in names if name == "triton"]
    on_cpu = [pytest.param((name, "cpu"), id=f"{name}-cpu") for name in names if name != "triton"]
    on_gpu = [
        pytest.param((name, "cuda"), id=f"{name}-cuda", marks=pytest.mark.gpu)
        for name in names
        if name not in _CPU_ONLY
    ]
    # Thousands of cases: those of a device that is not here are left out, not skipped one by one.
    return on_cpu + (on_gpu if torch.cuda.is_available() else [])


def require_route(name: str) -> None:
    """Skip a route whose package is missing."""
    if name in _PACKAGES and importlib.util.find_spec(name) is None:
        pytest.skip(f"{name} is not installed")
