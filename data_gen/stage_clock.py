"""CPU seconds of the stages of making a trajectory: simulate, render, write."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

STAGES = ("simulate", "render", "write")


@dataclass
class StageClock:
    """Adds up the processor time (user and system, all threads of this process) of each stage, in seconds."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Count what the block costs to ``stage``."""
        started = time.process_time()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.process_time() - started
