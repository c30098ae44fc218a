"""What a model must beat: the training mean of each camera, and the mean true displacement of the training set."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.data.ground_truth import has_state, read_state
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import DataError
from vpd_lightning.evaluation.protocol import NUM_CONTEXT


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


def mean_displacements(
    paths: Sequence[Path], start_frames: Sequence[int], num_steps: int
) -> dict[int, Float[Tensor, "step object 3"]]:
    """Mean true displacement (metres) of each object since the last input frame, over the training trajectories.

    One entry per start frame. This is the best prediction of motion that does not depend on the input: it knows the
    ground truth of the training set and is a reference, not a model. A start frame is left out where no training
    trajectory has state that reaches far enough, or where they differ in their number of objects.
    """
    displacements: dict[int, list[np.ndarray]] = {start: [] for start in start_frames}
    for path in paths:
        if not has_state(path):
            continue
        positions = read_state(path).positions
        for start in start_frames:
            current = start + NUM_CONTEXT - 1
            if len(positions) > current + num_steps:
                displacements[start].append(positions[current + 1 : current + 1 + num_steps] - positions[current])
    return {
        start: torch.from_numpy(np.mean(values, axis=0))
        for start, values in displacements.items()
        if values and len({value.shape for value in values}) == 1
    }
