"""Any metric of the list as a torchmetrics ``Metric`` that keeps every sample's values, also over several processes."""

from collections.abc import Sequence
from math import prod
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics import Metric

from vpd_lightning.metrics.body_track import measure_bodies
from vpd_lightning.metrics.metric_info import MetricInfo


class SampleMetric(Metric):
    """Measures sample by sample, with the function of the list, and keeps the values of each under its number.

    States are concatenated over processes. A sample that several processes measured (a distributed sampler repeats some
    so that all processes have as many) counts once, and samples are brought in the order of their numbers: one process
    and several give the same bits. ``compute`` returns the mean over samples of the mean over a sample's values;
    ``by_sample`` returns the values. ``last_step_only`` keeps only what is predicted last.
    """

    is_differentiable = False
    full_state_update = False
    samples: list[Tensor]
    shapes: list[Tensor]
    values: list[Tensor]

    def __init__(self, info: MetricInfo, *, last_step_only: bool = False) -> None:
        super().__init__()
        self.info, self.last_step_only = info, last_step_only
        # Shapes differ from sample to sample (numbers of bodies), so values are stored flat.
        for name in ("samples", "shapes", "values"):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(self, sample: int, *inputs: Any) -> None:
        """Measure the sample with that number; ``inputs`` are what the list says for the metric's subject."""
        values = torch.stack([part.detach() for part in self._measured(inputs)])
        if self.last_step_only:
            values = values[:, -1:] if self.info.subject == "image" else values[..., -1:]
        self.samples.append(torch.tensor([sample], device=values.device))
        self.shapes.append(torch.tensor(values.shape, device=values.device))
        self.values.append(values.to(self._value_dtype).flatten())

    def _measured(self, inputs: Sequence[Any]) -> list[Tensor]:
        if self.info.subject == "body":
            parts = measure_bodies(self.info, *inputs)
        else:
            parts = self.info.as_parts(self.info.load()(*inputs))
        return [parts[name] for name in self.info.part_names]

    @property
    def _value_dtype(self) -> torch.dtype:
        return torch.float32 if self.info.subject == "image" else torch.float64

    def sync(self, *args: Any, **kwargs: Any) -> None:
        """Gather the samples of all processes; one without samples contributes empty tensors of the right type."""
        kinds = {"samples": torch.int64, "shapes": torch.int64, "values": self._value_dtype}
        for name, dtype in kinds.items():
            if isinstance(getattr(self, name), list) and not getattr(self, name):
                setattr(self, name, [torch.empty(0, dtype=dtype, device=self.device)])
        super().sync(*args, **kwargs)

    def compute(self) -> Float[Tensor, ""]:
        """Mean over the samples that have values (those that are not NaN) of their means; NaN where none has."""
        known = [part[~part.isnan()] for part in (parts[0] for parts in self._by_sample().values())]
        means = [values.mean() for values in known if values.numel()]
        if not means:
            return torch.full((), torch.nan, dtype=self._value_dtype, device=self.device)
        # One after the other, so that the bits do not depend on how many there are.
        return sum(means[1:], start=means[0]) / len(means)

    def by_sample(self) -> dict[int, dict[str, Tensor]]:
        """Return each sample's values by part, of all processes and in the order of the samples' numbers."""
        with self.sync_context():
            found = self._by_sample()
        return {sample: dict(zip(self.info.part_names, parts, strict=True)) for sample, parts in found.items()}

    def _by_sample(self) -> dict[int, Tensor]:
        samples, shapes, values = (_joined(getattr(self, name)) for name in ("samples", "shapes", "values"))
        found: dict[int, Tensor] = {}
        if not len(samples):
            return found
        start = 0
        for sample, shape in zip(samples.tolist(), shapes.reshape(len(samples), -1).tolist(), strict=True):
            found.setdefault(sample, values[start : start + prod(shape)].reshape(shape))
            start += prod(shape)
        return dict(sorted(found.items()))


def _joined(state: list[Tensor] | Tensor) -> Tensor:
    """A state is a list of tensors, and one tensor while it is gathered."""
    if isinstance(state, Tensor):
        return state
    return torch.cat(state) if state else torch.empty(0, dtype=torch.int64)
