"""``vpd-train`` that kills itself inside the writing of a checkpoint.

``python -m tests.reliability.killed_training PLACE COUNT WORDS...``: SIGKILL at the given place of the COUNT-th
checkpoint of this process. Every call goes through the operating system as in a real training up to there.
"""

import os
import signal
import sys
from pathlib import Path
from typing import Any

from vpd_lightning.commands import train
from vpd_lightning.training import checkpoint_io

PLACES = ("half written", "written", "flushed", "other name given", "renamed")


def die() -> None:
    """As if the power went, for this process."""
    os.kill(os.getpid(), signal.SIGKILL)


def write_half(path: Path, data: Any) -> None:
    """Write half of what is given, and die."""
    with path.open("wb") as stream:
        stream.write(bytes(data)[: len(data) // 2])
    die()


def arm(place: str) -> None:
    """Replace the call of the operating system that stands for the place by one that dies."""
    if place == "half written":
        Path.write_bytes = write_half  # type: ignore[method-assign]
        return
    name, is_before = {
        "written": ("fsync", True),
        "flushed": ("fsync", False),
        "other name given": ("link", False),
        "renamed": ("replace", False),
    }[place]
    real = getattr(os, name)

    def deadly(*arguments: Any, **options: Any) -> None:
        if not is_before:
            real(*arguments, **options)
        die()

    setattr(os, name, deadly)


def main() -> int:
    """Train until the fatal checkpoint, or to the end where it has fewer."""
    place, count, words = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
    real = checkpoint_io.AtomicCheckpointIO.save_checkpoint
    saved = 0

    def save(self: Any, *arguments: Any, **options: Any) -> None:
        nonlocal saved
        saved += 1
        if saved == count:
            arm(place)
        real(self, *arguments, **options)

    checkpoint_io.AtomicCheckpointIO.save_checkpoint = save  # type: ignore[method-assign]
    return train.main(words)


if __name__ == "__main__":
    sys.exit(main())
