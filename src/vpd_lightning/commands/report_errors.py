"""How every console command ends: a named error in at most five lines, and the exit code of the error."""

import os
import signal
import sys
import traceback
from collections.abc import Callable
from types import FrameType

from vpd_lightning.errors import VPDError

MAX_LINES = 5
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143


def run_command(function: Callable[[], int | None]) -> int:
    """Run a command's body and return its exit code; errors go to stderr without a traceback.

    A ``VPDError`` is printed in at most five lines and gives its own exit code; Ctrl-C gives 130 and SIGTERM 143 (after
    the body's ``finally`` clauses ran). ``debug=true`` among the arguments, or ``VPD_DEBUG=1`` in the environment, adds
    the traceback. Anything else is a fault of this program and keeps its traceback.
    """
    previous = _terminate_softly()
    try:
        return function() or 0
    except VPDError as error:
        if wants_traceback():
            traceback.print_exc()
        print(format_error(error), file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        if wants_traceback():
            traceback.print_exc()
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # The reader of our output (head, less) went away. Python would complain at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    finally:
        if previous is not None:
            signal.signal(signal.SIGTERM, previous)


def format_error(error: BaseException) -> str:
    """Return ``error: <message>`` with at most five lines; what is cut off can be had with ``debug=true``."""
    lines = [line for line in str(error).strip().splitlines() if line.strip()] or [type(error).__name__]
    if len(lines) > MAX_LINES:
        lines = [*lines[: MAX_LINES - 1], f"... {len(lines) - MAX_LINES + 1} more lines with debug=true"]
        if wants_traceback():
            lines = str(error).strip().splitlines()
    return "error: " + "\n       ".join(lines)


def wants_traceback() -> bool:
    """Tell whether the user asked for tracebacks: ``debug=true`` among the arguments, or ``VPD_DEBUG=1``."""
    return os.environ.get("VPD_DEBUG", "") not in ("", "0") or any(
        argument.lower() in ("debug=true", "debug=1") for argument in sys.argv[1:]
    )


def _terminate_softly() -> signal.Handlers | Callable[[int, FrameType | None], object] | int | None:
    """Turn SIGTERM into ``SystemExit(143)`` so that ``finally`` clauses run; None where that is not possible."""

    def leave(signum: int, frame: FrameType | None) -> None:
        raise SystemExit(EXIT_TERMINATED)

    try:
        return signal.signal(signal.SIGTERM, leave)
    except ValueError:  # not the main thread, or an interpreter without signals
        return None
