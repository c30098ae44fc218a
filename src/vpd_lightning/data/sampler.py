"""Which items of the clip dataset make the batch of each training step, on each rank."""

from collections.abc import Callable, Iterator
from typing import Any

from torch.utils.data import DataLoader, Sampler

from vpd_lightning.errors import ConfigError


class StepBatchSampler(Sampler[list[int]]):
    """Yields this rank's slice of the global batch, step after step, from the current step on.

    Rank r of W takes samples r * B / W ... (r + 1) * B / W - 1 of a global batch of B, so that one rank with 16 samples
    and 16 ranks with one sample train on the same clips. ``first_step`` is called when iteration begins: a resumed run
    goes on where it stopped. The length counts all steps, those already done included, as Lightning's own counter does.
    """

    def __init__(
        self, *, batch_size: int, max_steps: int, rank: int, world_size: int, first_step: Callable[[], int]
    ) -> None:
        if batch_size % world_size:
            raise ConfigError(
                f"data.batch_size={batch_size} is the size over all devices and must divide by their number,"
                f" which is {world_size}.\nUse a multiple of {world_size}, or other trainer.devices."
            )
        self.batch_size, self.max_steps, self.first_step = batch_size, max_steps, first_step
        share = batch_size // world_size
        self._members = range(rank * share, (rank + 1) * share)

    def __len__(self) -> int:
        return self.max_steps

    def __iter__(self) -> Iterator[list[int]]:
        for step in range(self.first_step(), self.max_steps):
            yield [step * self.batch_size + member for member in self._members]


class StepLoader(DataLoader[Any]):
    """A loader without state: its sampler asks the trainer where to resume. The methods make Lightning accept that."""

    def state_dict(self) -> dict[str, Any]:
        """Return nothing."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Need nothing."""
