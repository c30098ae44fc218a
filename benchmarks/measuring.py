"""Rows, clocks and interleaved repeats: everything that a suite needs to measure."""

import functools
import platform
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import torch

SIZES = ("full", "quick", "tiny")


@dataclass(frozen=True)
class Options:
    """How to measure. ``size`` is full, quick or tiny (tests); ``checkpoints`` are trained models for two suites.

    ``preset`` is that of the trajectories which suite data makes.
    """

    device: torch.device
    size: str
    repeats: int
    checkpoints: Sequence[Path] = ()
    data: Path | None = None
    preset: str = "tiny"

    def pick(self, full: Any, quick: Any, tiny: Any) -> Any:
        """Return the value that belongs to the size."""
        return {"full": full, "quick": quick, "tiny": tiny}[self.size]


@dataclass(frozen=True)
class Row:
    """One line of a result. ``ratio`` is baseline_seconds / seconds: how many times faster than the baseline.

    ``error`` and ``psnr`` (dB to the true picture) are what ``note`` says. ``peak_bytes`` is what the work needs beyond
    what was there before: resident memory of a process of its own on a CPU, allocated memory on a GPU.
    """

    name: str
    baseline: str
    seconds: float | None
    baseline_seconds: float | None
    ratio: float | None
    error: float | None
    psnr: float | None
    peak_bytes: int | None
    note: str = ""


@dataclass(frozen=True)
class Result:
    """What a suite found: rows, and named numbers that belong to the suite as a whole (rates, floors, exponents)."""

    rows: Sequence[Row]
    facts: Mapping[str, Any] = field(default_factory=dict)


def row(
    name: str,
    seconds: Sequence[float] = (),
    baseline: str = "",
    baseline_seconds: Sequence[float] = (),
    error: float | None = None,
    psnr: float | None = None,
    peak_bytes: int | None = None,
    note: str = "",
) -> Row:
    """Make a row of the medians of repeated measurements."""
    here = median(seconds) if seconds else None
    there = median(baseline_seconds) if baseline_seconds else None
    ratio = there / here if here and there is not None else None
    return Row(name, baseline, here, there, ratio, error, psnr, peak_bytes, note)


def seconds_now(device: torch.device) -> float:
    """Return a clock: wall time; on one CPU thread the time of this process, which other programs do not disturb."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif torch.get_num_threads() == 1:
        return time.process_time()
    return time.perf_counter()


def interleaved(
    functions: Mapping[str, Callable[[], Any]],
    repeats: int,
    device: torch.device,
    warm_up: bool = True,
    clock: Callable[[], float] | None = None,
) -> dict[str, list[float]]:
    """Time functions in turns, so that what slows the machine for a while slows all of them; seconds per function.

    ``clock`` None: that of the device.
    """
    now = clock or functools.partial(seconds_now, device)
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for repeat in range(repeats + warm_up):
        for name, function in functions.items():
            start = now()
            function()
            taken = now() - start
            if repeat or not warm_up:
                seconds[name].append(taken)
    return seconds


def device_peak(function: Callable[[], Any], device: torch.device) -> int | None:
    """Return the bytes that a call allocates on a GPU beyond what is there; None on a CPU."""
    if device.type != "cuda":
        return None
    torch.cuda.synchronize(device)
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device)
    function()
    torch.cuda.synchronize(device)
    return torch.cuda.max_memory_allocated(device) - before


class Stopwatch:
    """Seconds per named stage. A stage inside a stage counts for the inner one only."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.seconds: dict[str, float] = defaultdict(float)
        self._stack: list[str] = []
        self._last = 0.0

    def _turn(self) -> None:
        """Book the time since the last turn on the stage that is running."""
        now = seconds_now(self.device)
        if self._stack:
            self.seconds[self._stack[-1]] += now - self._last
        self._last = now

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Book what happens inside on ``name``."""
        self._turn()
        self._stack.append(name)
        try:
            yield
        finally:
            self._turn()
            self._stack.pop()

    def timed(self, function: Callable[..., Any], name: str, inside: str) -> Callable[..., Any]:
        """Return ``function``, booked on ``name`` where it is called directly within the stage ``inside``.

        Recomputation within the backward pass therefore stays part of the backward pass.
        """

        def call(*args: Any, **kwargs: Any) -> Any:
            if not self._stack or self._stack[-1] != inside:
                return function(*args, **kwargs)
            with self.stage(name):
                return function(*args, **kwargs)

        return call


@contextmanager
def replaced(owner: Any, attribute: str, value: Any) -> Iterator[None]:
    """Put ``value`` in the place of an attribute for a while."""
    is_own = attribute in vars(owner)
    kept = getattr(owner, attribute)
    setattr(owner, attribute, value)
    try:
        yield
    finally:
        if is_own:
            setattr(owner, attribute, kept)
        else:  # it was the class's
            delattr(owner, attribute)


@contextmanager
def num_threads(count: int) -> Iterator[None]:
    """Let PyTorch compute on this many threads for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def device_name(device: torch.device) -> str:
    """Name the processor or the GPU, with the number of threads where it matters."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return f"{model}, {torch.get_num_threads()} thread(s)"


def gemm_rate(device: torch.device, dtype: torch.dtype = torch.float32, size: int = 1024) -> float:
    """Return the operations per second of a big matrix product, the best of several: what a network can hope for."""
    left, right = (torch.randn(size, size, device=device).to(dtype) for _ in range(2))
    seconds = interleaved({"product": lambda: left @ right}, 7, device)["product"]
    return 2 * size**3 / max(min(seconds), 1e-9)


def copy_rate(device: torch.device, num_bytes: int = 1 << 27) -> float:
    """Return the bytes per second, read plus written, of a copy that no cache holds."""
    source = torch.zeros(num_bytes // 4, device=device)
    target = torch.empty_like(source)
    seconds = interleaved({"copy": lambda: target.copy_(source)}, 5, device)["copy"]
    return 2 * num_bytes / max(min(seconds), 1e-9)
