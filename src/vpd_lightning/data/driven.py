"""The given motion of a recording, read from its file and checked."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vpd_lightning.data import schema
from vpd_lightning.data.driven_motion import DrivenMotion
from vpd_lightning.data.hdf5.broken_file import refuse
from vpd_lightning.data.hdf5.checks import check_links, checked_dataset, open_file
from vpd_lightning.data.hdf5.stored_chunks import read_whole

_MAX_LENGTH_ERROR = 1e-3  # of normals and of rotations
_LAYOUT = {
    schema.ACTION_POINTS: (np.float32, 3),
    schema.ACTION_NORMALS: (np.float32, 3),
    schema.ACTION_GROUPS: (np.int32, 1),
}  # name: dtype, number of axes
_POSES = {schema.ACTION_POSES: (np.float64, 4), schema.ACTION_COMMANDED_POSES: (np.float64, 4)}


def read_driven(path: str | Path) -> DrivenMotion | None:
    """Read the given motion of one trajectory; None where it has none.

    Raises:
        DataError: arrays are missing, do not fit each other or the number of frames, or hold no points and rotations.
    """
    path = Path(path)
    with open_file(path) as file:
        group = file.get(schema.ACTION)
        if group is None:
            return None
        if not isinstance(group, h5py.Group):
            raise refuse(path, "not_a_group", f"{schema.ACTION!r} is not a group")
        layout: Mapping[str, tuple[Any, int]] = {**_LAYOUT, **{name: _POSES[name] for name in _POSES if name in group}}
        check_links(path, group)
        arrays = {
            name: read_whole(path, checked_dataset(path, group, name, dtypes=[dtype], num_axes=[num_axes]))
            for name, (dtype, num_axes) in layout.items()
        }
        num_frames = file[schema.RGB].shape[0]
    driven = DrivenMotion(**arrays)
    check_driven(path, driven, num_frames)
    return driven


def check_driven(path: Path, driven: DrivenMotion, num_frames: int) -> None:
    """Refuse arrays that do not fit each other or the number of frames, or that are no points and rotations.

    Raises:
        DataError: naming the file and the fault.
    """
    num_points = driven.points.shape[1]
    for name in (schema.ACTION_POINTS, schema.ACTION_NORMALS):
        shape = getattr(driven, name).shape
        if shape != (num_frames, num_points, 3):
            fault = f"action/{name} has shape {shape}; it must be {(num_frames, num_points, 3)}: a row for every frame"
            raise refuse(path, "action_shape", fault)
    if driven.groups.shape != (num_points,) or sorted(set(driven.groups.tolist())) != list(range(driven.num_groups)):
        fault = (
            f"action/{schema.ACTION_GROUPS} must give each of the {num_points} points its part: 0, 1, 2, without gaps"
        )
        raise refuse(path, "action_groups", fault)
    if not np.isfinite(driven.points).all():
        raise refuse(path, "action_not_finite", f"action/{schema.ACTION_POINTS} is not finite everywhere")
    if not np.allclose(np.linalg.norm(driven.normals, axis=-1), 1, atol=_MAX_LENGTH_ERROR):
        raise refuse(path, "action_normals", f"action/{schema.ACTION_NORMALS} are not of unit length")
    for name in _POSES:
        poses = getattr(driven, name)
        if poses is None:
            continue
        if poses.shape != (num_frames, driven.num_groups, 4, 4):
            fault = f"action/{name} has shape {poses.shape}; it must be {(num_frames, driven.num_groups, 4, 4)}"
            raise refuse(path, "action_shape", fault)
        turned = poses[..., :3, :3] @ np.swapaxes(poses[..., :3, :3], -1, -2)
        if not np.isfinite(poses).all() or np.abs(turned - np.eye(3)).max() > _MAX_LENGTH_ERROR:
            raise refuse(path, "action_poses", f"action/{name} are not rotations and places")
