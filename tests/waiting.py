"""Waiting for another process or thread: for what it does, however long a slow or busy machine needs for that."""

import time
from collections.abc import Callable
from typing import Any

HANG = 1200.0
"""Seconds after which something hangs: the one limit of time in the tests, so that nobody waits for ever."""


def wait_until(condition: Callable[[], Any], process: Any = None, pause: float = 0.02) -> None:
    """Wait until the condition holds.

    Args:
        condition: asked again and again.
        process: whose end, before the condition holds, is a failure; with ``poll`` and ``communicate`` of ``Popen``.
        pause: seconds between two questions.

    Raises:
        AssertionError: the process ended, with what it printed; or nothing happens any more.
    """
    end = time.monotonic() + HANG
    while not condition():
        if process is not None and process.poll() is not None and not condition():
            raise AssertionError(f"ended with {process.returncode} before it came so far: {process.communicate()}")
        assert time.monotonic() < end, "nothing happens any more"
        time.sleep(pause)
