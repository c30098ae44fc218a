"""Ground-truth state of a trajectory: for evaluation and plots only; the training path never imports this module."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data import schema
from vpd_lightning.data.hdf5.checks import check_links, checked_dataset, open_file
from vpd_lightning.data.hdf5.stored_chunks import read_whole
from vpd_lightning.errors import DataError


@dataclass(frozen=True)
class GroundTruth:
    """What the simulator knew. World frame, metres, seconds, radians; quaternions w x y z, body to world.

    ``segmentation`` is 0 for floor and background, ``i + 1`` for object ``i`` and 255 for what is driven (a robot).
    ``half_sizes`` are along the body's own axes. Soft bodies have vertices as well (all bodies one after another), the
    object that each belongs to, and the tetrahedra between them; their poses are those of the rigid motion that fits
    best, their half sizes those at rest.
    """

    positions: NDArray[np.float64]  # (time, object, 3)
    quaternions: NDArray[np.float64]  # (time, object, 4)
    linear_velocities: NDArray[np.float64]  # (time, object, 3)
    angular_velocities: NDArray[np.float64]  # (time, object, 3)
    half_sizes: NDArray[np.float64]  # (object, 3)
    segmentation: NDArray[np.uint8]  # (time, view, height, width)
    vertices: NDArray[np.float32] | None = None  # (time, vertex, 3)
    vertex_objects: NDArray[np.int32] | None = None  # (vertex,)
    tetrahedra: NDArray[np.int32] | None = None  # (element, 4), indices into vertices
    depth: NDArray[np.float32] | None = None  # (time, view, height, width) where a sensor was simulated
    cam_to_world: NDArray[np.float64] | None = None  # (view, 4, 4) where a sensor was simulated

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
_SOFT_LAYOUT = {
    schema.STATE_VERTICES: (np.float32, 3),
    schema.STATE_VERTEX_OBJECTS: (np.int32, 1),
    schema.STATE_TETRAHEDRA: (np.int32, 2),
}
_CLEAN_LAYOUT = {schema.STATE_DEPTH: (np.float32, 4), schema.STATE_CAM_TO_WORLD: (np.float64, 3)}


def has_state(path: str | Path) -> bool:
    """Tell whether a trajectory carries the whole ground truth."""
    with open_file(Path(path)) as file:
        return schema.STATE in file and all(name in file[schema.STATE] for name in _LAYOUT)


def read_positions(path: str | Path) -> NDArray[np.float64] | None:
    """Read the positions (time, object, 3) alone; None where the trajectory does not carry the whole ground truth."""
    path = Path(path)
    with open_file(path) as file:
        if schema.STATE not in file or any(name not in file[schema.STATE] for name in _LAYOUT):
            return None
        return _read(path, file[schema.STATE], {schema.STATE_POSITIONS: _LAYOUT[schema.STATE_POSITIONS]})[
            schema.STATE_POSITIONS
        ]


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
        soft = [name for name in _SOFT_LAYOUT if name in group]
        if soft and len(soft) < len(_SOFT_LAYOUT):
            raise DataError(
                f"{path} has only a part of the ground truth of soft bodies ({', '.join(soft)}).\n"
                f"{schema.STATE}/ needs {', '.join(_SOFT_LAYOUT)}, or none of them where bodies are rigid."
            )
        clean = {name: layout for name, layout in _CLEAN_LAYOUT.items() if name in group}
        arrays = _read(path, group, {**_LAYOUT, **(_SOFT_LAYOUT if soft else {}), **clean})
    state = GroundTruth(**arrays)
    _check_meshes(path, state)
    return state


def _read(path: Path, group: h5py.Group, layout: Mapping[str, tuple[Any, int]]) -> dict[str, NDArray[Any]]:
    check_links(path, group)
    return {
        name: read_whole(path, checked_dataset(path, group, name, dtypes=[dtype], num_axes=[num_axes]))
        for name, (dtype, num_axes) in layout.items()
    }


def _check_meshes(path: Path, state: GroundTruth) -> None:
    """Refuse vertices that do not fit the poses, and indices that point at nothing."""
    if state.vertices is None or state.vertex_objects is None or state.tetrahedra is None:
        return
    num_times, num_vertices = state.vertices.shape[:2]
    sound = (
        num_times == state.positions.shape[0]
        and state.vertices.shape[2] == 3
        and state.vertex_objects.shape == (num_vertices,)
        and state.tetrahedra.shape[1] == 4
        and 0 <= state.vertex_objects.min() <= state.vertex_objects.max() < state.num_objects
        and 0 <= state.tetrahedra.min() <= state.tetrahedra.max() < num_vertices
    )
    if not sound:
        raise DataError(
            f"{path}: {', '.join(_SOFT_LAYOUT)} in {schema.STATE}/ do not fit each other or the poses.\n"
            "Allowed: (time, vertex, 3); (vertex,), numbers of objects; (element, 4), numbers of vertices."
        )
