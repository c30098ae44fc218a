"""How many frames a training clip has to predict, in the course of the training."""

from collections.abc import Mapping, Sequence

from vpd_lightning.randomness import numpy_generator

Schedule = Mapping[float, int | Sequence[int]]


class RolloutLengths:
    """``num_steps`` always, or what ``schedule`` says.

    ``schedule`` maps fractions of the training to T, each valid from its fraction on. Where it names several T
    (``{0.0: 1, 0.5: [1, 8]}``) every update draws one of them, the same for all clips of its batch.
    """

    def __init__(self, num_steps: int, schedule: Schedule | None) -> None:
        """Read the schedule.

        Raises:
            ValueError: a fraction outside of [0, 1), none that says what holds from the start, or a T below 1.
        """
        self._lengths = {
            float(start): [int(steps)] if isinstance(steps, int) else [int(item) for item in steps]
            for start, steps in (schedule or {0.0: num_steps}).items()
        }
        if schedule and (
            0.0 not in self._lengths
            or not all(0.0 <= start < 1.0 for start in self._lengths)
            or not all(lengths and min(lengths) >= 1 for lengths in self._lengths.values())
        ):
            raise ValueError(
                "num_steps_schedule maps fractions of the training in [0, 1) to rollout lengths >= 1 (or lists of them,"
                f" of which every update draws one) and must say what holds from 0.0 on, got {dict(schedule)}"
            )
        self.longest = max(num_steps, *(max(lengths) for lengths in self._lengths.values()))

    def at(self, fraction: float, seed: int, step: int) -> int:
        """Return T of update ``step``, at which ``fraction`` of the training is done."""
        lengths = max((start, lengths) for start, lengths in self._lengths.items() if start <= fraction)[1]
        if len(lengths) == 1:
            return lengths[0]
        return lengths[int(numpy_generator(seed, step, "rollout length").integers(len(lengths)))]

    def ahead(self, fraction: float) -> list[tuple[float, list[int]]]:
        """Return the shares of the training that lie beyond ``fraction`` and the T that each draws from, in order."""
        starts = sorted(self._lengths)
        parts = [
            (end - max(start, fraction), self._lengths[start])
            for start, end in zip(starts, [*starts[1:], 1.0], strict=True)
        ]
        return [(share, lengths) for share, lengths in parts if share > 0]
