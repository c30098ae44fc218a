"""A set of two recordings in which a box is tossed while something driven, under the floor, goes past."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.data.recordings import write_dataset_file
from tests.evaluation.tossed_box import tossed_box
from vpd_lightning.data.driven_motion import DrivenMotion
from vpd_lightning.data.schema import write_trajectory

BELOW = -0.9  # the tool is under the floor, where no camera could see through it
STEP = 0.02


def write_pushed_boxes(folder: Path) -> Path:
    """Write them, one for training and one for the test."""
    box = tossed_box(100)
    poses = np.tile(np.eye(4), (len(box.rgb), 1, 1, 1))
    poses[:, 0, 0, 3] = STEP * np.arange(len(poses))
    points = 0.01 * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]) + [0, 0, BELOW]
    motion = DrivenMotion.carried(points, np.tile([0.0, 0, 1], (4, 1)), np.zeros(4, np.int32), poses, poses)
    files = {}
    for split in ("train", "test"):
        files[split] = [folder / split / "000000.h5"]
        write_trajectory(files[split][0], replace(box, action=motion.as_arrays()))
    return write_dataset_file(folder, {**files, "validation": []})
