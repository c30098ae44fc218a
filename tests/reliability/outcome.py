"""What a reliability check found, and how it is written down."""

import fcntl
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

RESULTS = Path("benchmarks/results/reliability_cpu.json")


@dataclass(frozen=True)
class Outcome:
    """One promise: what was tried how often, how often it held, and what else was seen."""

    promise: str
    tried: int
    held: int
    seen: str = ""

    @property
    def is_kept(self) -> bool:
        return self.tried > 0 and self.held == self.tried

    def __str__(self) -> str:
        return f"{'ok  ' if self.is_kept else 'FAIL'} {self.promise}: {self.held} of {self.tried}. {self.seen}"


def write(check: str, outcomes: Sequence[Outcome], seconds: float, path: Path = RESULTS) -> None:
    """Put the outcomes of one check in place of its last ones."""
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)  # checks run in several processes
        content = json.loads(path.read_text()) if path.is_file() else {}
        content[check] = {"seconds": round(seconds), "outcomes": [asdict(item) for item in outcomes]}
        path.write_text(json.dumps(dict(sorted(content.items())), indent=1) + "\n")
    finally:
        os.close(folder)


def read(path: Path = RESULTS) -> dict[str, list[Outcome]]:
    """Return the outcomes by check."""
    content = json.loads(path.read_text())
    return {check: [Outcome(**item) for item in rows["outcomes"]] for check, rows in content.items()}
