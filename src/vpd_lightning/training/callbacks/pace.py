"""How long an update takes, by the number of frames that its clips predict."""

from collections.abc import Sequence

_CONTEXT = 2
"""Frames that an update reads before those that it predicts: they count as much, where nothing was measured."""


class Pace:
    """Seconds and updates that were measured, for each rollout length."""

    def __init__(self) -> None:
        self.counted: dict[int, tuple[float, int]] = {}

    def count(self, length: int, seconds: float, steps: int = 1) -> None:
        """Add what ``steps`` updates of clips of ``length`` predicted frames took."""
        before = self.counted.get(length, (0.0, 0))
        self.counted[length] = before[0] + seconds, before[1] + steps

    @property
    def is_known(self) -> bool:
        """Whether anything was counted that took time."""
        return sum(seconds for seconds, _ in self.counted.values()) > 0

    def seconds_per_step(self, lengths: Sequence[int]) -> float:
        """Return the mean over ``lengths``; one that was not seen yet is judged by the nearest one that was.

        Without any, it is the mean over all updates.
        """
        if not lengths:
            seconds, steps = (sum(part) for part in zip(*self.counted.values(), strict=True))
            return seconds / steps
        return sum(self._of(length) for length in lengths) / len(lengths)

    def _of(self, length: int) -> float:
        nearest = min(self.counted, key=lambda seen: (abs(seen - length), -seen))
        seconds, steps = self.counted[nearest]
        return seconds / steps * (length + _CONTEXT) / (nearest + _CONTEXT)
