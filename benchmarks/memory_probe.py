"""Memory of one piece of work in a process of its own: ``python -m benchmarks.memory_probe '{"work": ..., ...}'``.

Prints ``{"peak_bytes": ...}``: the most resident memory while it ran, beyond what was resident before (weights, input,
libraries).
"""

import contextlib
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import torch


def peak_of(work: str, **arguments: Any) -> dict[str, Any]:
    """Run ``benchmarks.MODULE:FUNCTION(**arguments)`` in a process of its own, and measure what it returns, a call.

    Raises:
        RuntimeError: the process failed; the message ends with what it said last.
    """
    request = json.dumps({"work": work, "arguments": arguments, "threads": torch.get_num_threads()})
    command = [sys.executable, "-m", "benchmarks.memory_probe", request]
    root = str(Path(__file__).resolve().parents[1])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    # The reserve that glibc keeps for later would count as needed.
    environment = {**os.environ, "PYTHONPATH": path, "MALLOC_ARENA_MAX": "1", "MALLOC_TRIM_THRESHOLD_": "0"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise RuntimeError(f"{work} failed in a process of its own:\n{done.stderr[-800:]}")
    return json.loads(done.stdout.splitlines()[-1])


def measure(prepare: Callable[[], Callable[[], Any]]) -> dict[str, Any]:
    """Prepare, then call; return the peak beyond the preparation, and the whole peak of the process."""
    call = prepare()
    before = _forget_peak()
    answer = call()
    peak = _peak()
    return {"peak_bytes": max(0, peak - before), "process_bytes": peak, "answer": answer}


def _forget_peak() -> int:
    """Let the peak start again from what is resident now, and return that; where the system cannot: the old peak."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _peak()


def _peak() -> int:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024
    except (OSError, StopIteration):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024


def main() -> None:
    """Do what the request in the command line says."""
    request = json.loads(sys.argv[1])
    torch.set_num_threads(request["threads"])
    module, _, function = request["work"].partition(":")
    work = getattr(import_module(f"benchmarks.{module}"), function)
    print(json.dumps(measure(lambda: work(**request["arguments"]))))


if __name__ == "__main__":
    main()
