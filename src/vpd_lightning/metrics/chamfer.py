"""Chamfer distance between two point sets."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor


@dataclass(frozen=True)
class ChamferDistance:
    """Mean nearest distances in metres: ``accuracy`` from predicted to true points, ``completeness`` back."""

    accuracy: float
    completeness: float

    @property
    def mean(self) -> float:
        """The symmetric distance: the mean of both directions (Chamfer-L1 of Mescheder et al. 2019)."""
        return 0.5 * (self.accuracy + self.completeness)


def chamfer(pred: Float[Tensor, "point 3"], target: Float[Tensor, "other_point 3"]) -> ChamferDistance:
    """Chamfer-L1 distance in metres (not squared); NaN where either set is empty."""
    if pred.shape[0] == 0 or target.shape[0] == 0:
        return ChamferDistance(float("nan"), float("nan"))
    pred_points, target_points = pred.detach().cpu().double().numpy(), target.detach().cpu().double().numpy()
    accuracy = cKDTree(target_points).query(pred_points)[0].mean()
    completeness = cKDTree(pred_points).query(target_points)[0].mean()
    return ChamferDistance(float(accuracy), float(completeness))


def chamfer_by_step(
    positions: Float[Tensor, "step particle 3"], true_points: Sequence[Float[Tensor, "_point 3"]]
) -> dict[str, Float[Tensor, " step"]]:
    """Return both directions and their mean for the particles of every step; NaN where they are not finite."""
    missing = ChamferDistance(float("nan"), float("nan"))
    found = [
        chamfer(pred, points) if bool(torch.isfinite(pred).all()) else missing
        for pred, points in zip(positions, true_points, strict=True)
    ]
    return {
        part: torch.tensor([getattr(distance, part) for distance in found], dtype=torch.float64)
        for part in ("mean", "accuracy", "completeness")
    }
