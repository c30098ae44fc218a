"""Means and bootstrap intervals: clips of one trajectory are not independent, so trajectories are what is resampled."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.metrics.psnr import PSNR_CAP


def summarize(values: NDArray[Any], trajectory: NDArray[np.int64], num_bootstrap: int) -> dict[str, Any]:
    """Summarise an array whose first axis counts clips and whose last axis counts steps; NaN means "no value".

    ``mean`` is the mean over all values (over images, that is), ``ci95`` its 95 % percentile bootstrap interval over
    trajectories (fixed seed), ``std_trajectories`` the spread of the trajectories' own means, ``per_step`` the mean at
    each step and ``count`` the number of values. Numbers that do not exist are None.
    """
    values = np.asarray(values, dtype=np.float64)
    known = ~np.isnan(values)
    filled = np.where(known, values, 0.0)
    clip_sum, clip_count = filled.reshape(len(values), -1).sum(1), known.reshape(len(values), -1).sum(1)
    names = np.unique(trajectory)
    total = np.array([clip_sum[trajectory == name].sum() for name in names])
    count = np.array([clip_count[trajectory == name].sum() for name in names])
    total, count = total[count > 0], count[count > 0]
    axes = tuple(range(values.ndim - 1))
    step_count = known.sum(axes)
    per_step = filled.sum(axes) / np.maximum(step_count, 1)
    return {
        "mean": plain(total.sum() / count.sum()) if count.size else None,
        "ci95": _bootstrap(total, count, num_bootstrap),
        "std_trajectories": plain(np.std(total / count, ddof=1)) if count.size > 1 else None,
        "per_step": [plain(value) if number else None for value, number in zip(per_step, step_count, strict=True)],
        "count": int(known.sum()),
    }


def _bootstrap(total: NDArray[np.float64], count: NDArray[np.int64], num_bootstrap: int) -> list[float] | None:
    if count.size < 2:
        return None
    picks = np.random.default_rng(0).integers(0, count.size, size=(num_bootstrap, count.size))
    means = total[picks].sum(1) / count[picks].sum(1)
    return [float(value) for value in np.percentile(means, [2.5, 97.5])]


def pooled_psnr(mse: NDArray[Any]) -> float | None:
    """PSNR in dB of the mean squared error over all images; unlike the mean PSNR it is dominated by bad images."""
    known = mse[~np.isnan(mse)]
    if not known.size:
        return None
    mean = float(known.mean())
    return PSNR_CAP if mean <= 0 else min(float(-10.0 * np.log10(mean)), PSNR_CAP)


def plain(value: Any) -> float | None:
    """A float that JSON can hold; None for what is not finite."""
    number = float(value)
    return number if np.isfinite(number) else None
