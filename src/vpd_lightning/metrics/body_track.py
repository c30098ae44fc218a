"""The particles of one body over a rollout, beside what truly happened to it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.metrics.body_dynamics import centroid_velocity
from vpd_lightning.metrics.metric_info import MetricInfo

MIN_BODY_PARTICLES = 5
"""A body that fewer particles show has no value."""


@dataclass(frozen=True)
class Obstacle:
    """The true box of another rigid body, at each step; ``shared`` are particles that lie in it from the start."""

    half_size: Float[Tensor, " 3"]
    poses: Float[Tensor, "true_step 7"]
    shared: Bool[Tensor, " particle"]


@dataclass(frozen=True)
class BodyTrack:
    """The particles of one body, world frame, metres and seconds.

    ``positions`` are the predicted ones, those of the last input frame first; ``true`` is where its true motion carries
    them, from the same frame on and as far as the recording goes; ``before`` is where they were one frame earlier.
    ``surface`` are a soft body's true triangles over the time of ``true``, None for a rigid one. ``constant`` is the
    median displacement in the training set (None: not known), ``floor_height`` NaN where no floor is seen.
    """

    positions: Float[Tensor, "time particle 3"]
    true: Float[Tensor, "true_time particle 3"]
    before: Float[Tensor, "particle 3"]
    surface: Float[Tensor, "true_time triangle 3 3"] | None
    constant: Float[Tensor, "constant_step 3"] | None
    frame_time: float
    floor_height: float = float("nan")
    obstacles: Sequence[Obstacle] = ()

    @property
    def num_steps(self) -> int:
        """How many steps are predicted."""
        return self.positions.shape[0] - 1

    @property
    def num_true(self) -> int:
        """How many of them the recording shows."""
        return min(self.num_steps, self.true.shape[0] - 1)

    @property
    def is_soft(self) -> bool:
        """Whether it changes its shape, so that metrics of rigid motion do not apply."""
        return self.surface is not None

    @property
    def start(self) -> Float[Tensor, "particle 3"]:
        """The particles at the last input frame."""
        return self.positions[0]

    @cached_property
    def finite(self) -> Bool[Tensor, " step"]:
        """Which steps were predicted in numbers."""
        return torch.isfinite(self.positions[1:]).all(-1).all(-1)

    @cached_property
    def predicted(self) -> Float[Tensor, "step particle 3"]:
        """The prediction, with the start in the place of what is not finite; ``judged`` takes that out again."""
        return torch.where(self.finite[:, None, None], self.positions[1:], self.start)

    @property
    def true_steps(self) -> Float[Tensor, "true_step particle 3"]:
        """The truth at the predicted steps that the recording shows."""
        return self.true[1 : self.num_true + 1]

    @cached_property
    def velocity(self) -> Float[Tensor, "step 3"]:
        """Predicted velocity of the centroid over each step; NaN where either end is not finite."""
        moved = centroid_velocity(torch.cat([self.start[None], self.predicted]), self.frame_time)
        return torch.where(self.both_ends_finite[:, None], moved, torch.nan)

    @property
    def both_ends_finite(self) -> Bool[Tensor, " step"]:
        """Which steps lead from a finite prediction (or the start) to a finite one."""
        return self.finite & torch.cat([self.finite.new_ones(1), self.finite[:-1]])

    @cached_property
    def true_velocity(self) -> Float[Tensor, "true_step 3"]:
        """True velocity of the centroid over each step."""
        return centroid_velocity(self.true[: self.num_true + 1], self.frame_time)

    def judged(self, values: Float[Tensor, " first_step"]) -> Float[Tensor, " step"]:
        """Values of the prediction over its first steps: NaN behind them, and where it is not finite."""
        padded = self.padded(values)
        return torch.where(self.finite, padded, torch.nan)

    def padded(self, values: Float[Tensor, " first_step"]) -> Float[Tensor, " step"]:
        """Values over the first steps, NaN behind them."""
        missing = torch.full((self.num_steps - values.shape[0],), torch.nan, dtype=torch.float64)
        return torch.cat([values.double(), missing])

    def unknown(self) -> Float[Tensor, " step"]:
        """No value at any step."""
        return torch.full((self.num_steps,), torch.nan, dtype=torch.float64)


def measure_bodies(info: MetricInfo, tracks: Sequence[BodyTrack]) -> dict[str, Float[Tensor, "object step"]]:
    """Measure every body, by part of the metric; NaN for one that the particles hardly show (fewer than 5 of them)."""
    function, rows = info.load(), []
    for track in tracks:
        is_shown = track.start.shape[0] >= MIN_BODY_PARTICLES
        rows.append(info.as_parts(function(track)) if is_shown else dict.fromkeys(info.part_names, track.unknown()))
    return {part: torch.stack([row[part] for row in rows]) for part in info.part_names}
