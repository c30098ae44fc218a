"""A training whose disk gets full, read-only, or vanishes; runs inside a mount namespace of its own.

``python -m tests.reliability.disks_child full|read-only|vanished FOLDER DATA``: prints what became of it as JSON.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.reliability.trainings import start, words
from vpd_lightning.errors import CheckpointError
from vpd_lightning.training.checkpoints import find_resume

CHECKPOINTS_THAT_FIT = 2.5


def harm(how: str, disk: Path, data: Path) -> dict[str, Any]:
    """Train on a small disk of its own, do the harm after a few steps, and look at what is left."""
    size = "64m"
    if how == "full":  # measured first: how large is a checkpoint?
        probe = disk.with_name("probe")
        start(words(data, probe, 3)).communicate(timeout=300)
        size = str(int(CHECKPOINTS_THAT_FIT * (probe / "checkpoints" / "last.ckpt").stat().st_size))
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(disk)], check=True)
    run = disk / "run"
    process = start(words(data, run, 2000))
    shown = []
    for line in process.stdout or ():
        shown.append(line)
        if line.startswith("step 8/") and how != "full":
            break
    if how == "read-only":
        for options in ("bind", "remount,ro,bind"):  # over itself: files that are open would keep the disk writable
            subprocess.run(["mount", "-o", options, str(disk), str(disk)], check=True)
    elif how == "vanished":
        shutil.rmtree(run)
    rest, _ = process.communicate(timeout=300)
    try:
        kept = find_resume(run).name
    except CheckpointError:
        kept = ""
    output = "".join(shown) + rest
    return {"code": process.returncode, "output": output[-2000:], "kept": kept}


if __name__ == "__main__":
    print("\n" + json.dumps(harm(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))))
