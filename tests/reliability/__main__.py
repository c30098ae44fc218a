"""Check the promises of docs/reliability.md: ``python -m tests.reliability [CHECK ...]``; all without a name."""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
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

SIDE_BY_SIDE = (
    ("kills", "signals", "determinism", "checkpoints"),
    ("reader", "importers", "disks", "offline"),
)
"""What leaves a core idle: run as two processes at once. The other checks use both cores, or need a quiet machine."""


def main() -> int:
    """Run the checks, print each outcome, write them down; 1 where a promise was not kept."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checks", nargs="*", default=[], help=f"of {', '.join(CHECKS)}; all without any")
    options = parser.parse_args()
    if unknown := set(options.checks) - set(CHECKS):
        parser.error(f"no such check: {', '.join(sorted(unknown))}; there are {', '.join(CHECKS)}")
    if options.checks:
        return 0 if check(options.checks) else 1
    began = time.monotonic()
    command = [sys.executable, "-m", "tests.reliability"]
    beside = [subprocess.Popen([*command, *names]) for names in SIDE_BY_SIDE]
    codes = [process.wait() for process in beside]
    taken = {name for names in SIDE_BY_SIDE for name in names}
    is_kept = check([name for name in CHECKS if name not in taken]) and not any(codes)
    print(f"all in {(time.monotonic() - began) / 60:.0f} minutes", flush=True)
    return 0 if is_kept else 1


def check(names: Sequence[str]) -> bool:
    """Run checks one after the other; true where every promise was kept."""
    is_kept = True
    with tempfile.TemporaryDirectory(prefix="vpd-reliability-") as folder:
        for name in names:
            if name in POSSIBLE and not POSSIBLE[name]():
                print(f"== {name}: left out, this machine does not allow it", flush=True)
                continue
            began = time.monotonic()
            outcomes = CHECKS[name](Path(folder))
            seconds = time.monotonic() - began
            print("\n".join([f"== {name} ({seconds:.0f} s)", *map(str, outcomes)]), flush=True)
            write(name, outcomes, seconds)
            is_kept = is_kept and all(outcome.is_kept for outcome in outcomes)
    return is_kept


if __name__ == "__main__":
    sys.exit(main())
