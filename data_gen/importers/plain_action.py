"""``action.npz`` of a plain folder: what a robot did, frame by frame, in the cameras' world and its unit.

One of two forms, as points that moved or as links that carried them::

    points       (time, particle, 3)     on the robot's surface: the same particles in all frames
    normals      (time, particle, 3)     outward, of unit length
    groups       (particle,)             optional: the link that each belongs to, 0, 1, 2 ...; else all are of one

    link_points  (particle, 3)           on each link's surface, in the link's own frame
    link_normals (particle, 3)
    groups       (particle,)             optional, as above
    poses        (time, link, 4, 4)      link to world, by the robot's forward kinematics

and, with either, ``poses`` and ``commanded_poses`` (time, link, 4, 4): measured, and what the controller was asked for.
"""

from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.driven import check_driven
from vpd_lightning.data.driven_motion import DrivenMotion
from vpd_lightning.data.schema import ACTION_COMMANDED_POSES, ACTION_GROUPS, ACTION_NORMALS, ACTION_POINTS, ACTION_POSES
from vpd_lightning.errors import DataError

ACTION_FILE = "action.npz"
_LINK_POINTS, _LINK_NORMALS = "link_points", "link_normals"
_NAMES = (
    ACTION_POINTS, ACTION_NORMALS, ACTION_GROUPS, ACTION_POSES, ACTION_COMMANDED_POSES, _LINK_POINTS, _LINK_NORMALS,
)  # fmt: skip
_FORMS = f"either {ACTION_POINTS} and {ACTION_NORMALS}, or {_LINK_POINTS}, {_LINK_NORMALS} and {ACTION_POSES}"


def read_action(path: Path, num_frames: int) -> DrivenMotion | None:
    """Read what a robot did; None where the recording has no such file.

    Raises:
        DataError: it cannot be read, holds other arrays, or they do not fit each other or the number of frames.
    """
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
    except (OSError, ValueError, BadZipFile) as error:
        raise DataError(f"{path} is no NumPy archive of plain arrays (numpy.savez): {error}") from error
    unknown = sorted(set(arrays) - set(_NAMES))
    if unknown:
        raise DataError(f"{path} holds {', '.join(unknown)}; known: {', '.join(_NAMES)}.")
    for name, values in arrays.items():
        if values.dtype.kind not in ("iu" if name == ACTION_GROUPS else "iuf"):
            raise DataError(f"{path}: {name} is {values.dtype}; numbers are needed.")
    is_links = _LINK_POINTS in arrays
    needed = (_LINK_POINTS, _LINK_NORMALS, ACTION_POSES) if is_links else (ACTION_POINTS, ACTION_NORMALS)
    missing = [name for name in needed if name not in arrays]
    if missing or (is_links and ACTION_POINTS in arrays):
        raise DataError(f"{path} needs {_FORMS}; it holds {', '.join(arrays) or 'nothing'}.")
    num_points = arrays[needed[0]].shape[0 if is_links else 1] if arrays[needed[0]].ndim > 1 else 0
    groups = arrays.get(ACTION_GROUPS, np.zeros(num_points, np.int32)).astype(np.int32)
    poses, commanded = (
        arrays[name].astype(np.float64) if name in arrays else None for name in (ACTION_POSES, ACTION_COMMANDED_POSES)
    )
    if is_links and poses is not None:
        _check_links(path, arrays, groups)
        driven = DrivenMotion.carried(arrays[_LINK_POINTS], arrays[_LINK_NORMALS], groups, poses, commanded)
    else:
        points, normals = (arrays[name].astype(np.float32) for name in (ACTION_POINTS, ACTION_NORMALS))
        driven = DrivenMotion(points, normals, groups, poses, commanded)
    if driven.points.ndim != 3 or not num_points or groups.shape != (num_points,):
        raise DataError(f"{path}: {needed[0]} has shape {arrays[needed[0]].shape}, groups {groups.shape}: {_FORMS}.")
    check_driven(path, driven, num_frames)
    return driven


def _check_links(path: Path, arrays: dict[str, NDArray[Any]], groups: NDArray[np.int32]) -> None:
    points, normals, poses = (arrays[name] for name in (_LINK_POINTS, _LINK_NORMALS, ACTION_POSES))
    fits = points.ndim == 2 and points.shape[1:] == (3,) and normals.shape == points.shape
    fits = fits and groups.shape == points.shape[:1] and poses.ndim == 4 and poses.shape[2:] == (4, 4)
    if not fits or not 0 <= groups.min() <= groups.max() < poses.shape[1]:
        shapes = ", ".join(f"{name} {values.shape}" for name, values in arrays.items())
        raise DataError(f"{path}: {shapes} do not fit each other: {_FORMS}; groups are numbers of links.")
