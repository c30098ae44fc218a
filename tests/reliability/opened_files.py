"""Whether anybody opens a file: Linux's inotify through the C library."""

import ctypes
import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

_IN_OPEN = 0x20
_EVENT_SIZE = 16  # without a name: only files are watched


class OpenedFiles:
    """Counts how often the given files were opened, by any process, since the start of the block."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._library = ctypes.CDLL(None, use_errno=True)
        self._descriptor = self._library.inotify_init1(os.O_NONBLOCK)
        for path in paths:
            if self._library.inotify_add_watch(self._descriptor, os.fsencode(path), _IN_OPEN) < 0:
                raise OSError(ctypes.get_errno(), "inotify cannot watch", str(path))

    def __enter__(self) -> "OpenedFiles":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        os.close(self._descriptor)

    def count(self) -> int:
        """Return how many files were opened since the last call."""
        total = 0
        while True:
            try:
                total += len(os.read(self._descriptor, 2**16)) // _EVENT_SIZE
            except BlockingIOError:
                return total
