"""Other people's camera and depth conventions, turned into ours: once, here, and nowhere else."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from data_gen.importers.lens import undistort
from vpd_lightning.errors import DataError

Array = NDArray[np.float64]

ORTHONORMAL_TOLERANCE = 1e-4  # files hold poses printed with few digits, or float32 ones
_UP_AXES = {"x": (0, 1.0), "y": (1, 1.0), "z": (2, 1.0), "-x": (0, -1.0), "-y": (1, -1.0), "-z": (2, -1.0)}
UP_CHOICES = tuple(_UP_AXES)


def opengl_to_opencv(cam_to_world: Array) -> Array:
    """Turn poses (..., 4, 4) of cameras with x right, y up, z back into x right, y down, z forward (exactly)."""
    return cam_to_world * np.array([1.0, -1.0, -1.0, 1.0])


def invert_pose(pose: Array) -> Array:
    """Invert rigid poses (..., 4, 4): world to camera becomes camera to world."""
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    inverse = np.zeros_like(pose)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ pose[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def pose_matrix(rotation: Array, position: Array) -> Array:
    """Join rotations (..., 3, 3) and positions (..., 3) to poses (..., 4, 4)."""
    pose = np.zeros((*rotation.shape[:-2], 4, 4))
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = position
    pose[..., 3, 3] = 1.0
    return pose


def rotation_from_quaternion(quaternion: ArrayLike, order: str = "wxyz") -> Array:
    """Return rotations (..., 3, 3) from quaternions (..., 4); they are normalised first.

    Args:
        quaternion: none may be zero.
        order: ``wxyz`` (MuJoCo, Kubric) or ``xyzw`` (ROS, TUM, SciPy).
    """
    if order not in ("wxyz", "xyzw"):
        raise ValueError(f"order is {order!r}; allowed: wxyz, xyzw")
    values = np.asarray(quaternion, np.float64)
    rotations = Rotation.from_quat(values.reshape(-1, 4), scalar_first=order == "wxyz")
    return rotations.as_matrix().reshape(*values.shape[:-1], 3, 3)


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Array:
    """Return intrinsics (3, 3) in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def shift_principal_point(intrinsics: Array, offset: float) -> Array:
    """Add ``offset`` pixels to cx and cy of (..., 3, 3): +0.5 where a source has pixel centres at integers."""
    shifted = intrinsics.copy()
    shifted[..., :2, 2] += offset
    return shifted


def ray_lengths(height: int, width: int, intrinsics: Array, distortion: Array | None = None) -> Array:
    """Return (height, width): the length of each pixel's ray per unit along the optical axis, at least 1.

    ``intrinsics`` (3, 3) with pixel centres at +0.5; ``distortion`` OpenCV's 5 or 8 numbers of the same view. Infinite
    where the lens model cannot be inverted.
    """
    v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    y = (v - intrinsics[1, 2]) / intrinsics[1, 1]
    x = (u - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
    if distortion is not None and np.any(distortion):
        x, y = undistort(x, y, distortion)
    return np.nan_to_num(np.sqrt(1.0 + x * x + y * y), nan=np.inf)


def distance_to_z(distance: NDArray[Any], intrinsics: Array, distortion: Array | None = None) -> NDArray[np.float32]:
    """Turn distances to the camera centre (height, width) into depth along the optical axis (0 stays 0).

    For distorted images the ray of each pixel is found with the view's ``distortion``.
    """
    height, width = distance.shape
    lengths = ray_lengths(height, width, intrinsics, distortion)
    return (distance.astype(np.float64) / lengths).astype(np.float32)


def world_rotation(up: str) -> Array:
    """Return the (4, 4) rotation that turns the world's axis ``up`` into z, by quarter turns."""
    axis, sign = _UP_AXES[up]
    turn = np.eye(4)
    if (axis, sign) == (2, 1.0):
        return turn
    if (axis, sign) == (2, -1.0):
        return np.diag([1.0, -1.0, -1.0, 1.0])
    other = 1 - axis
    # The third row picks the new z; the kept axis stays; the sign of the last row follows from right-handedness.
    turn[:3, :3] = 0.0
    turn[2, axis] = sign
    turn[other, other] = 1.0
    turn[axis, 2] = -sign
    return turn


def checked_pose(matrix: ArrayLike, where: str) -> Array:
    """Return a rigid pose (4, 4) from 3x4 or 4x4 numbers, or raise ``DataError`` that names place and fault.

    ``where`` says which matrix it is, for example ``cameras.json, view left, frame 3: cam_to_world``.
    """
    values = _numbers(matrix, where)
    if values.shape == (3, 4):
        values = np.vstack([values, [0.0, 0.0, 0.0, 1.0]])
    if values.shape != (4, 4):
        raise DataError(f"{where} has shape {values.shape}; a 4x4 (or 3x4) matrix is needed.")
    if not np.isfinite(values).all():
        raise DataError(
            f"{where} holds NaN or infinity.\nWas tracking lost there? Cut the recording, or mend the pose."
        )
    if not np.allclose(values[3], [0.0, 0.0, 0.0, 1.0], atol=1e-9, rtol=0):
        hint = " It looks transposed." if np.allclose(values[:3, 3], 0.0) else ""
        raise DataError(f"{where} does not end in the row 0 0 0 1.{hint}")
    rotation = values[:3, :3]
    gram = rotation @ rotation.T
    if np.abs(gram - np.eye(3)).max() > ORTHONORMAL_TOLERANCE:
        size = float(np.sqrt(np.trace(gram) / 3))
        if np.abs(gram / size**2 - np.eye(3)).max() < ORTHONORMAL_TOLERANCE:
            raise DataError(
                f"{where} holds a rotation scaled by {size:.6g}.\nDivide its upper left 3x3 by that number."
            )
        raise DataError(
            f"{where} holds no rotation (rows are not orthonormal; error {np.abs(gram - np.eye(3)).max():.2g})."
        )
    if np.linalg.det(rotation) < 0:
        raise DataError(f"{where} is left-handed (determinant -1).\nOne axis is mirrored: flip the sign of one column.")
    return values


def checked_intrinsics(matrix: ArrayLike, where: str) -> Array:
    """Return intrinsics (3, 3) ``[[fx, s, cx], [0, fy, cy], [0, 0, 1]]``, or raise a ``DataError`` with the fault."""
    values = _numbers(matrix, where)
    if values.shape != (3, 3):
        raise DataError(f"{where} has shape {values.shape}; a 3x3 matrix is needed.")
    if not np.isfinite(values).all():
        raise DataError(f"{where} holds NaN or infinity.")
    if not np.array_equal(values[2], [0.0, 0.0, 1.0]) or values[1, 0] != 0:
        raise DataError(f"{where} is not [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels (is it transposed?).")
    if values[0, 0] <= 0 or values[1, 1] <= 0:
        raise DataError(
            f"{where} has focal lengths {values[0, 0]:.6g}, {values[1, 1]:.6g}; they must be positive pixels."
        )
    return values


def _numbers(matrix: ArrayLike, where: str) -> Array:
    try:
        return np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{where} is not a matrix of numbers.") from error


def join_views(views: Sequence[Array], num_frames: int) -> Array:
    """Stack the matrices of all views: (view, n, n), or (time, view, n, n) where one of them changes."""
    still = [matrices[0] if matrices.ndim == 3 and (matrices == matrices[:1]).all() else matrices for matrices in views]
    if all(matrices.ndim == 2 for matrices in still):
        return np.stack(still)
    shape = (num_frames, *still[0].shape[-2:])
    return np.stack([np.broadcast_to(matrices, shape) for matrices in still], axis=1)
