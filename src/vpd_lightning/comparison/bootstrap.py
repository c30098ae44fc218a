"""Means over images, seeds and trajectories, and their bootstrap intervals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

# Draws of the trajectories are the same everywhere (so that systems stay paired), draws of the seeds are not.
_TRAJECTORIES, _SEEDS_FIRST, _SEEDS_SECOND = 0, 1, 2


@dataclass(frozen=True)
class MetricSamples:
    """What one metric gave for several seeds of one system: sums and counts of its known values.

    Axes ``seed trajectory step``. Means weigh every value (every image) of a seed the same, and every seed the same.
    """

    total: Float[np.ndarray, "seed trajectory step"]
    count: Int[np.ndarray, "seed trajectory step"]

    def mean(self) -> float | None:
        """Mean over the seeds of their means; None where some seed has no value."""
        means = _ratio(self.total.sum((1, 2)), self.count.sum((1, 2)))
        return None if np.isnan(means).any() else float(means.mean())

    def per_step(self) -> Float[np.ndarray, " step"]:
        """The mean of each step; NaN where some seed has no value."""
        return _ratio(self.total.sum(1), self.count.sum(1)).mean(0)

    def only(self, kept: Bool[np.ndarray, "trajectory step"]) -> "MetricSamples":
        """The same with some of its values, of the trajectories that have any left."""
        rows = kept.any(1)
        return MetricSamples(np.where(kept, self.total, 0.0)[:, rows], np.where(kept, self.count, 0)[:, rows])

    def known(self) -> Bool[np.ndarray, "trajectory step"]:
        """Which steps of which trajectories have values in every seed."""
        return self.count.min(0) > 0


@dataclass(frozen=True)
class Estimate:
    """A mean and its 95 % interval (None where one trajectory, or no array, says nothing about the spread)."""

    mean: float
    interval: tuple[float, float] | None

    def overlaps(self, other: "Estimate") -> bool:
        """Tell whether the intervals share a value; one without an interval is a point."""
        low, high = self.interval or (self.mean, self.mean)
        other_low, other_high = other.interval or (other.mean, other.mean)
        return low <= other_high and other_low <= high


def sums_of(values: NDArray[np.floating], trajectory: NDArray[np.int64]) -> tuple[NDArray, NDArray]:
    """Sum an array (``clip ... step``; NaN: no value) over everything but trajectories and steps.

    Returns totals and counts, both ``trajectory step``, trajectories in the order of their indices.
    """
    known = ~np.isnan(values)
    filled = np.where(known, values, 0.0)
    between = tuple(range(1, values.ndim - 1))
    total, count = filled.sum(between, dtype=np.float64), known.sum(between)
    rows = [trajectory == index for index in np.unique(trajectory)]
    return np.stack([total[row].sum(0) for row in rows]), np.stack([count[row].sum(0) for row in rows])


def estimate(samples: MetricSamples, num_bootstrap: int) -> Estimate | None:
    """Estimate the mean; the interval is the percentile bootstrap (Efron 1979) over trajectories and seeds.

    Each replicate draws as many trajectories as there are, with replacement and the same for all seeds, and as many
    seeds as there are. With one seed it says how much the score depends on the trajectories only, and is the ``ci95``
    of ``metrics.json`` where every trajectory has values. Two or three seeds understate how much seeds differ.
    """
    mean = samples.mean()
    if mean is None:
        return None
    return Estimate(mean, _interval(_replicates(samples, num_bootstrap, _SEEDS_FIRST)))


def step_band(samples: MetricSamples, num_bootstrap: int) -> Float[np.ndarray, "2 step"]:
    """Lower and upper end of the interval of each step; NaN where there is none."""
    num_steps = samples.total.shape[2]
    ends = [
        _interval(
            _replicates(
                MetricSamples(samples.total[..., i : i + 1], samples.count[..., i : i + 1]), num_bootstrap, _SEEDS_FIRST
            )
        )
        for i in range(num_steps)
    ]
    return np.array([(np.nan, np.nan) if end is None else end for end in ends]).T


def difference(first: MetricSamples, second: MetricSamples, num_bootstrap: int) -> tuple[Estimate, int] | None:
    """Estimate first minus second over the steps of trajectories that both have, and the number of trajectories.

    The same trajectories are drawn for both, because both saw the same clips: what makes a clip hard for both does not
    widen the interval. Seeds are drawn for each by itself.
    """
    shared = first.known() & second.known()
    first, second = first.only(shared), second.only(shared)
    means = first.mean(), second.mean()
    if not shared.any() or means[0] is None or means[1] is None:
        return None
    replicates = _replicates(first, num_bootstrap, _SEEDS_FIRST) - _replicates(second, num_bootstrap, _SEEDS_SECOND)
    return Estimate(means[0] - means[1], _interval(replicates)), int(shared.any(1).sum())


def stacked(parts: Sequence[tuple[NDArray, NDArray]]) -> MetricSamples:
    """Put what several seeds gave together."""
    return MetricSamples(np.stack([total for total, _ in parts]), np.stack([count for _, count in parts]))


def _replicates(samples: MetricSamples, num_bootstrap: int, seed_stream: int) -> Float[np.ndarray, " replicate"]:
    num_seeds, num_trajectories = samples.total.shape[:2]
    if num_trajectories < 2:
        return np.full(num_bootstrap, np.nan)
    picks = np.random.default_rng(_TRAJECTORIES).integers(0, num_trajectories, size=(num_bootstrap, num_trajectories))
    total, count = samples.total.sum(2), samples.count.sum(2)
    means = np.stack([_ratio(total[seed][picks].sum(1), count[seed][picks].sum(1)) for seed in range(num_seeds)])
    seeds = np.random.default_rng(seed_stream).integers(0, num_seeds, size=(num_bootstrap, num_seeds))
    return means[seeds, np.arange(num_bootstrap)[:, None]].mean(1)


def _interval(replicates: NDArray[np.floating]) -> tuple[float, float] | None:
    known = replicates[~np.isnan(replicates)]
    if not known.size:
        return None
    low, high = np.percentile(known, [2.5, 97.5])
    return float(low), float(high)


def _ratio(total: NDArray, count: NDArray) -> NDArray[np.float64]:
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
