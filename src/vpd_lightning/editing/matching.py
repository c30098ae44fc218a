"""Which particle of the current frame a particle of the previous frame stands for."""

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.spatial import cKDTree
from torch import Tensor

from vpd_lightning.types import Particles

_NUM_ROUNDS = 12
_COLOR_SHARE = 1.0
"""A difference of 1 in colour counts as this many widths of a cluster."""


def match_frames(
    previous: Particles,
    current: Particles,
    clusters: Int64[Tensor, " particle"],
    previous_colors: Float[Tensor, "previous_particle 3"] | None,
    current_colors: Float[Tensor, "particle 3"] | None,
) -> Int64[Tensor, " previous_particle"]:
    """Return for each particle of the previous frame the slot of the current one that it stands for.

    The two observed frames have no correspondences, but what is deleted or moved must go from both. Each cluster of the
    current frame is moved back to where it came from (iterated nearest points by place and colour, translation only);
    then the nearest particle is taken. Good enough to tell bodies apart; not a velocity. Padding stands for slot 0.
    """
    device = previous.positions.device
    origin = torch.zeros(previous.num_particles, dtype=torch.int64)
    there, now = previous.mask[0].cpu().numpy(), current.mask[0].cpu().numpy()
    if not there.any() or not now.any():
        return origin.to(device)
    old, new = _numbers(previous.positions[0])[there], _numbers(current.positions[0])[now]
    labels = clusters.cpu().numpy()[now]
    known = previous_colors is not None and current_colors is not None
    old_colors = _numbers(previous_colors)[there] if known else np.zeros_like(old)  # type: ignore[arg-type]
    new_colors = _numbers(current_colors)[now] if known else np.zeros_like(new)  # type: ignore[arg-type]
    moved, widths = new.copy(), []
    for label in range(int(labels.max(initial=-1)) + 1):
        own = labels == label
        width = float(np.linalg.norm(np.ptp(new[own], axis=0)))
        widths.append(width)
        moved[own] -= _displacement(new[own], new_colors[own], old, old_colors, _COLOR_SHARE * width)
    weight = _COLOR_SHARE * float(np.median(widths)) if widths else 0.0
    tree = cKDTree(np.concatenate([moved, weight * new_colors], axis=1))
    nearest = tree.query(np.concatenate([old, weight * old_colors], axis=1))[1]
    origin[torch.from_numpy(np.flatnonzero(there))] = torch.from_numpy(np.flatnonzero(now)[nearest])
    return origin.to(device)


def _displacement(
    points: np.ndarray, colors: np.ndarray, old: np.ndarray, old_colors: np.ndarray, weight: float
) -> np.ndarray:
    """Return how far a cluster came since the previous frame (metres); the median is not led by what is hidden."""
    tree = cKDTree(np.concatenate([old, weight * old_colors], axis=1))
    shift = np.zeros(3)
    for _ in range(_NUM_ROUNDS):
        nearest = tree.query(np.concatenate([points - shift, weight * colors], axis=1))[1]
        following = np.median(points - old[nearest], axis=0)
        if np.allclose(following, shift, atol=1e-9):
            break
        shift = following
    return shift


def _numbers(values: Tensor) -> np.ndarray:
    return values.detach().cpu().double().numpy()
