"""``vpd-train`` that kills itself inside the writing of a checkpoint.

``python -m tests.reliability.killed_training PLACE COUNT WORDS...``: SIGKILL at the given place of the COUNT-th
checkpoint of this process. Every call goes through the operating system as in a real training up to there.
"""

import io
import os
import signal
import sys
from typing import Any

from vpd_lightning.commands import train
from vpd_lightning.training import checkpoint_io

PLACES = ("half written", "written", "flushed", "other name given", "renamed")


def die() -> None:
    """As if the power went, for this process."""
    os.kill(os.getpid(), signal.SIGKILL)


class HalfWriter(io.FileIO):
    """Writes half of the first thing it is given, and dies."""

    def write(self, data: Any) -> int:
        super().write(bytes(data)[: len(data) // 2])
        die()
        raise AssertionError("not reached")


def arm(place: str) -> None:
    """Replace the call of the operating system that stands for the place by one that dies."""
    if place == "half written":
        os.fdopen = lambda handle, mode: HalfWriter(handle, mode)  # type: ignore[assignment]
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
