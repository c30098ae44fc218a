"""What a model must beat: the training mean of each camera, and the median true displacement of the training set."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from vpd_lightning.data.ground_truth import read_positions
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import DataError
from vpd_lightning.types import NUM_CONTEXT_FRAMES

_NUM_ITERATIONS = 100
_SOFTENING = 1e-4  # m


def training_mean(paths: Sequence[Path]) -> Float[Tensor, "view height width 3"]:
    """Mean image of each camera over all frames of all training trajectories, in [0, 1].

    Of all pictures that do not depend on the input, this one has the smallest squared error on the training set.
    """
    total: np.ndarray | None = None
    count = 0
    for path in paths:
        with TrajectoryReader(path) as reader:
            images = reader.rgb(range(reader.num_frames), range(reader.num_views))
        summed = images.sum(axis=0, dtype=np.float64)
        if total is not None and total.shape != summed.shape:
            raise DataError(f"{path} has images of shape {summed.shape}, earlier trajectories {total.shape}.")
        total = summed if total is None else total + summed
        count += images.shape[0]
    if total is None:
        raise DataError("The training split is empty, so there is no training mean to compare with.")
    return torch.from_numpy((total / (255.0 * count)).astype(np.float32))


def median_displacements(
    paths: Sequence[Path], start_frames: Sequence[int], num_steps: int
) -> dict[int, Float[Tensor, "step object 3"]]:
    """Geometric median of each object's true displacement (metres) since the last input frame, in the training set.

    One entry per start frame. The score is a mean distance, so of all predictions of motion that do not depend on the
    input this one has the smallest error on the training set: it uses the ground truth and is a reference, not a
    model. A start frame is left out where no training trajectory has state that reaches far enough, or where they
    differ in their number of objects.
    """
    displacements: dict[int, list[np.ndarray]] = {start: [] for start in start_frames}
    for path in paths:
        positions = read_positions(path)
        if positions is None:
            continue
        for start in start_frames:
            current = start + NUM_CONTEXT_FRAMES - 1
            if len(positions) > current + num_steps:
                displacements[start].append(positions[current + 1 : current + 1 + num_steps] - positions[current])
    return {
        start: torch.from_numpy(geometric_median(np.stack(values)))
        for start, values in displacements.items()
        if values and len({value.shape for value in values}) == 1
    }


def geometric_median(points: Float64[np.ndarray, "point *shape 3"]) -> Float64[np.ndarray, "*shape 3"]:
    """Point with the smallest mean distance to all points (metres), by Weiszfeld's iteration (1937) from their mean.

    Distances are taken as sqrt(d^2 + e^2) with e = 0.1 mm, so that an iterate on top of a point can leave it.
    """
    median = points.mean(axis=0)
    for _ in range(_NUM_ITERATIONS):
        squared = np.square(points - median).sum(axis=-1, keepdims=True)
        weights = 1.0 / np.sqrt(squared + _SOFTENING**2)
        median = (weights * points).sum(axis=0) / weights.sum(axis=0)
    return median
