"""Does a simulator stay stable far beyond the training length: a long rollout of one clip, judged by its particles."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

NUM_LAST_STEPS = 10


@dataclass(frozen=True)
class LongRollout:
    """One clip rolled out further. Metres (per step for the speed); one value per object where a list stands.

    ``floor_drift_*`` is the displacement of the particles outside every true box since the last input frame, its
    largest value over the steps, then median, 99th percentile and maximum over the particles. ``centroid_error`` is
    that of the last step the recording still shows. NaN where the prediction is not finite (at any step, or at that
    one) or hardly shows the object.
    """

    clip: str
    trajectory: int
    num_steps: int
    finite: bool
    floor_drift_median: float
    floor_drift_p99: float
    floor_drift_max: float
    size_ratio_end: list[float]
    size_ratio_min: list[float]
    size_ratio_max: list[float]
    lowest_point: list[float]
    final_speed: list[float]
    centroid_error: list[float]
    centroid_error_copy: list[float]


def judge_long_rollout(
    clip: str,
    trajectory: int,
    positions: Float[Tensor, "time particle 3"],
    bodies: Bool[Tensor, "object particle"],
    motion: dict[str, Float[Tensor, "object step"]],
) -> LongRollout:
    """Summarise a long rollout (``positions``: last observed first) with the motion metrics of the same steps."""
    finite = bool(torch.isfinite(positions).all())
    floor = positions[:, ~bodies.any(0)]
    drift = (floor[1:] - floor[0]).norm(dim=-1).amax(0)
    centroids = torch.stack([positions[:, mask].mean(1) for mask in bodies], dim=1)
    speeds = (centroids[1:] - centroids[:-1])[-NUM_LAST_STEPS:].norm(dim=-1).mean(0)
    size = motion["size_ratio"]
    return LongRollout(
        clip=clip,
        trajectory=trajectory,
        num_steps=positions.shape[0] - 1,
        finite=finite,
        floor_drift_median=_quantile(drift, 0.5),
        floor_drift_p99=_quantile(drift, 0.99),
        floor_drift_max=_quantile(drift, 1.0),
        size_ratio_end=size[:, -1].tolist(),
        size_ratio_min=size.amin(1).tolist(),
        size_ratio_max=size.amax(1).tolist(),
        lowest_point=motion["lowest_point"].amin(1).tolist(),
        final_speed=speeds.tolist(),
        centroid_error=_at_last_true_step(motion["centroid_error"], motion),
        centroid_error_copy=_at_last_true_step(motion["centroid_error_copy"], motion),
    )


def _quantile(values: Float[Tensor, " particle"], q: float) -> float:
    return float("nan") if values.numel() == 0 else float(torch.quantile(values, q))


def _at_last_true_step(
    values: Float[Tensor, "object step"], motion: dict[str, Float[Tensor, "object step"]]
) -> list[float]:
    """Read each object at its last step with ground truth, which the reference that needs no prediction shows."""
    rows = zip(values, motion["centroid_error_copy"].isfinite(), strict=True)
    return [float(row[true][-1]) if true.any() else float("nan") for row, true in rows]
