"""A progress bar with the remaining time; plain lines where there is no terminal."""

import sys
import time
from typing import Any, Self

_SECONDS_BETWEEN_LINES = 10.0


class Progress:
    """Counts finished trajectories; ``already_done`` ones do not enter the estimate of the remaining time."""

    def __init__(self, title: str, total: int, already_done: int) -> None:
        self.title, self.total, self.done, self.already_done = title, total, already_done, already_done
        self.started = self.last_line = time.monotonic()
        self.bar: Any = None
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
            from rich.progress import Progress as RichProgress

            self.bar = RichProgress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TextColumn("remaining"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
            )
            self.task = self.bar.add_task(title, total=total, completed=already_done)

    def __enter__(self) -> Self:
        if self.bar is not None:
            self.bar.start()
        elif self.already_done:
            self._line(f"{self.already_done} of {self.total} trajectories are there already")
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.stop()

    def advance(self) -> None:
        """Count one more finished trajectory."""
        self.done += 1
        if self.bar is not None:
            self.bar.advance(self.task)
            return
        now = time.monotonic()
        if now - self.last_line >= _SECONDS_BETWEEN_LINES or self.done == self.total:
            self.last_line = now
            elapsed = now - self.started
            remaining = elapsed / (self.done - self.already_done) * (self.total - self.done)
            self._line(f"{self.done}/{self.total} trajectories, {elapsed:.0f} s, {remaining:.0f} s remaining")

    def _line(self, text: str) -> None:
        print(f"{self.title}: {text}", file=sys.stderr, flush=True)
