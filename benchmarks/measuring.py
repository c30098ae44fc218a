"""Stopwatch, machine description and result files of the benchmarks."""

import json
import platform
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

import torch

RESULTS = Path(__file__).parent / "results"
PACKAGES = ("torch", "numpy", "scipy", "lightning", "torch-geometric")


@dataclass(frozen=True)
class Row:
    """One line of a result. ``ratio`` is baseline_seconds / seconds: how many times faster than the baseline.

    ``error`` compares the result with the baseline's where both compute the same; what it means stands in ``note``.
    ``peak_bytes`` is device memory, on a GPU only.
    """

    name: str
    baseline: str
    seconds: float
    baseline_seconds: float | None
    ratio: float | None
    error: float | None
    psnr: float | None
    peak_bytes: int | None
    note: str = ""


def row(
    name: str,
    seconds: Sequence[float],
    baseline: str = "",
    baseline_seconds: Sequence[float] | None = None,
    error: float | None = None,
    peak_bytes: int | None = None,
    note: str = "",
) -> Row:
    """Make a row of the medians of repeated measurements."""
    here = median(seconds)
    there = median(baseline_seconds) if baseline_seconds else None
    ratio = there / here if there is not None and here > 0 else None
    return Row(name, baseline, here, there, ratio, error, None, peak_bytes, note)


def seconds_now(device: torch.device) -> float:
    """Return a clock: wall time; on one CPU thread the time of this process, which other programs do not disturb."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif torch.get_num_threads() == 1:
        return time.process_time()
    return time.perf_counter()


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


def write(suite: str, device: torch.device, rows: Sequence[Row]) -> Path:
    """Write ``results/<suite>_<device>.json``, print the table, and return the path."""
    content = {
        "suite": suite,
        "device": device_name(device),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}},
        "rows": [asdict(item) for item in rows],
    }
    print(f"\n{content['device']}\n\n{table(rows)}\n")
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{suite}_{device.type}.json"
    path.write_text(json.dumps(content, indent=1) + "\n")
    print(path)
    return path


def table(rows: Sequence[Row]) -> str:
    """Return the rows as a Markdown table."""
    lines = ["| what | ms | baseline ms | ratio | error | baseline |", "|---|---:|---:|---:|---:|---|"]
    for item in rows:
        there = "" if item.baseline_seconds is None else f"{1000 * item.baseline_seconds:.1f}"
        ratio = "" if item.ratio is None else f"{item.ratio:.2f}x"
        error = "" if item.error is None else f"{item.error:.1e}"
        lines.append(f"| {item.name} | {1000 * item.seconds:.1f} | {there} | {ratio} | {error} | {item.baseline} |")
    return "\n".join(lines)
