"""How much a piece of code does, counted: unlike seconds, the same on a slow, a fast and a busy machine."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class Work:
    """What was counted: ``calls`` of functions, those of libraries included."""

    def __init__(self) -> None:
        self.calls = 0

    def count(self, frame: FrameType, event: str, argument: Any) -> None:
        self.calls += event in ("call", "c_call")


@contextmanager
def counted_calls() -> Iterator[Work]:
    """Count the calls of Python functions and of functions of libraries."""
    work, before = Work(), sys.getprofile()
    sys.setprofile(work.count)
    try:
        yield work
    finally:
        sys.setprofile(before)


class TensorWork(TorchDispatchMode):
    """Counts the operations of PyTorch, the numbers that they return, and the largest tensor among them."""

    def __init__(self) -> None:
        super().__init__()
        self.operations = self.numbers = self.largest = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = function(*args, **(kwargs or {}))
        self.operations += 1
        for value in out if isinstance(out, tuple | list) else [out]:
            size = value.numel() if isinstance(value, torch.Tensor) else 0
            self.numbers, self.largest = self.numbers + size, max(self.largest, size)
        return out
