"""Disks that are full, read-only, or gone: a named error, and the checkpoint before it whole."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.reliability.outcome import Outcome
from tests.reliability.trainings import environment, make_data

HARMS = ("full", "read-only", "vanished")
_PREFIX = ("unshare", "--map-root-user", "--mount")


def is_possible() -> bool:
    """Whether this machine lets us mount things in a namespace of our own."""
    try:
        done = subprocess.run([*_PREFIX, "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, check=False)
    except OSError:
        return False
    return done.returncode == 0


def disks(work: Path, *, harms: Sequence[str] = HARMS) -> list[Outcome]:
    """Do each harm to a real training."""
    data = make_data(work / "data")
    return [_outcome(how, _harmed(how, work, data)) for how in harms]


def _harmed(how: str, work: Path, data: Path) -> dict[str, object]:
    disk = work / f"disk_{how}"
    disk.mkdir()
    command = [*_PREFIX, sys.executable, "-m", "tests.reliability.disks_child", how, str(disk), str(data)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=600, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{how}: {done.stderr[-2000:]}{done.stdout[-2000:]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def _outcome(how: str, found: dict[str, object]) -> Outcome:
    output = str(found["output"])
    message = output[output.find("error: ") :].strip() if "error: " in output else ""
    is_named = 0 < len(message.splitlines()) <= 5 and "Traceback" not in output and found["code"] in (3, 4)
    held = is_named and (how == "vanished" or bool(found["kept"]))
    if os.environ.get("VPD_DISKS_VERBOSE"):
        print(how, found["code"], found["kept"], output)
    seen = f"exit code {found['code']}, kept: {found['kept'] or 'nothing'}"
    return Outcome(f"a training whose disk was {how} ended with a named error", 1, int(held), seen)
