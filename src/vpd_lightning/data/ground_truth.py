"""Ground-truth state of a trajectory: for evaluation and plots only; the training path never imports this module."""

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data import schema
from vpd_lightning.data.hdf5_checks import check_links, checked_dataset, open_file
from vpd_lightning.data.stored_chunks import read_whole
from vpd_lightning.errors import DataError


@dataclass(frozen=True)
class GroundTruth:
    """What the simulator knew. World frame, metres, seconds, radians; quaternions w x y z, body to world.

    ``segmentation`` is 0 for floor and background and ``i + 1`` for object ``i``. ``half_sizes`` are along the body's
    own axes.
    """

    positions: NDArray[np.float64]  # (time, object, 3)
    quaternions: NDArray[np.float64]  # (time, object, 4)
    linear_velocities: NDArray[np.float64]  # (time, object, 3)
    angular_velocities: NDArray[np.float64]  # (time, object, 3)
    half_sizes: NDArray[np.float64]  # (object, 3)
    segmentation: NDArray[np.uint8]  # (time, view, height, width)

    @property
    def num_objects(self) -> int:
        return self.positions.shape[1]


_LAYOUT = {
    schema.STATE_POSITIONS: (np.float64, 3),
    schema.STATE_QUATERNIONS: (np.float64, 3),
    schema.STATE_LINEAR_VELOCITIES: (np.float64, 3),
    schema.STATE_ANGULAR_VELOCITIES: (np.float64, 3),
    schema.STATE_HALF_SIZES: (np.float64, 2),
    schema.STATE_SEGMENTATION: (np.uint8, 4),
}  # name: dtype, number of axes


def has_state(path: str | Path) -> bool:
    """Tell whether a trajectory carries the whole ground truth."""
    with open_file(Path(path)) as file:
        return schema.STATE in file and all(name in file[schema.STATE] for name in _LAYOUT)


def read_state(path: str | Path) -> GroundTruth:
    """Read the ground truth of one trajectory; ``DataError`` where it has none or lacks a part."""
    path = Path(path)
    with open_file(path) as file:
        group = file.get(schema.STATE)
        if not isinstance(group, h5py.Group) or any(name not in group for name in _LAYOUT):
            raise DataError(
                f"{path} has no complete ground truth ({schema.STATE}/ needs {', '.join(_LAYOUT)}).\n"
                "What needs it cannot be evaluated on such recordings; the pixels can still be compared."
            )
        check_links(path, group)
        arrays = {
            name: read_whole(path, checked_dataset(path, group, name, dtypes=[dtype], num_axes=[num_axes]))
            for name, (dtype, num_axes) in _LAYOUT.items()
        }
    return GroundTruth(**arrays)
