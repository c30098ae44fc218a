"""Errors of steps that must not wait for the device: counted there, copied meanwhile, raised by a later call."""

import torch
from jaxtyping import Int64
from torch import Tensor

from vpd_lightning.errors import ConfigError, NonFiniteError

_UNKNOWN = -1


class DelayedFaults:
    """Holds the counts of steps whose result the device may not have computed yet, oldest first."""

    def __init__(self) -> None:
        self._pending: list[tuple[Tensor, int]] = []

    def watch(self, dropped_edges: Int64[Tensor, ""], non_finite: Int64[Tensor, ""], edge_capacity: int) -> None:
        """Start to copy the counts of a step to the host; on a CPU they are there and raise now."""
        counts = torch.stack([dropped_edges, non_finite])
        if counts.device.type == "cuda":
            # No event is needed to see that the copy has arrived: a count is never negative.
            on_host = torch.full((2,), _UNKNOWN, dtype=counts.dtype, pin_memory=True)
            self._pending.append((on_host.copy_(counts, non_blocking=True), edge_capacity))
            return
        self._pending.append((counts.cpu(), edge_capacity))
        self.raise_if_known()

    def raise_if_known(self) -> None:
        """Raise for the first fault among the counts that have arrived, without waiting for any."""
        while self._pending:
            counts, edge_capacity = self._pending[0]
            dropped, non_finite = counts.tolist()
            if _UNKNOWN in (dropped, non_finite):
                return
            del self._pending[0]
            if dropped or non_finite:
                self._pending.clear()
                _raise(dropped, non_finite, edge_capacity)

    def raise_if_any(self) -> None:
        """Wait for the device, then raise for the first fault."""
        if self._pending and torch.cuda.is_available():
            torch.cuda.synchronize()
        self.raise_if_known()


def _raise(dropped: int, non_finite: int, edge_capacity: int) -> None:
    if non_finite:
        raise NonFiniteError(
            f"Dynamics: {non_finite} particles of an earlier step are NaN or infinite.\n"
            "Either the model diverged, or depth or camera poses are damaged.\n"
            "Lower the learning rate, clip gradients, or check the data with vpd-data validate."
        )
    raise ConfigError(
        f"{dropped} edges among abstract nodes did not fit into edge_capacity={edge_capacity}: that step is wrong.\n"
        f"Set dynamics.edge_capacity={dropped + edge_capacity} or more (null: as many as there are), or bound them"
        " with dynamics.max_abstract_edges_per_node."
    )
