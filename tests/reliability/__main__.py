"""Check the promises of docs/reliability.md: ``python -m tests.reliability [CHECK ...]``; all without a name."""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from tests.reliability import checkpoints, determinism, disks, fuzz, kills, memory, offline, ranks, slurm
from tests.reliability.outcome import Outcome, write

CHECKS: dict[str, Callable[[Path], list[Outcome]]] = {
    "kills": kills.kills,
    "signals": kills.signals,
    "determinism": determinism.determinism,
    "checkpoints": checkpoints.checkpoints,
    "reader": fuzz.reader,
    "importers": fuzz.importers,
    "ranks": ranks.ranks,
    "slurm": slurm.slurm,
    "disks": disks.disks,
    "offline": offline.offline,
    "memory": memory.memory,
}

POSSIBLE = {"slurm": slurm.is_possible, "disks": disks.is_possible, "offline": offline.is_possible}


def main() -> int:
    """Run the checks, print each outcome, write them down; 1 where a promise was not kept."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checks", nargs="*", default=[], help=f"of {', '.join(CHECKS)}; all without any")
    options = parser.parse_args()
    if unknown := set(options.checks) - set(CHECKS):
        parser.error(f"no such check: {', '.join(sorted(unknown))}; there are {', '.join(CHECKS)}")
    is_kept = True
    with tempfile.TemporaryDirectory(prefix="vpd-reliability-") as folder:
        for name in options.checks or CHECKS:
            print(f"== {name}", flush=True)
            if name in POSSIBLE and not POSSIBLE[name]():
                print("left out: this machine does not allow it", flush=True)
                continue
            began = time.monotonic()
            outcomes = CHECKS[name](Path(folder))
            seconds = time.monotonic() - began
            for outcome in outcomes:
                print(outcome, flush=True)
            print(f"({seconds:.0f} s)", flush=True)
            write(name, outcomes, seconds)
            is_kept = is_kept and all(outcome.is_kept for outcome in outcomes)
    return 0 if is_kept else 1


if __name__ == "__main__":
    sys.exit(main())
