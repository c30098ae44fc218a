"""Refusing intrinsics and poses that cannot be what the format says."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.hdf5.broken_file import refuse

_ORTHONORMAL_TOLERANCE = 1e-4  # importers store float32 poses; beyond this a rotation is not one
_FOCAL_RANGE = (0.05, 200.0)  # focal length over image side: 170 degrees of view down to 0.3


def check_intrinsics(path: Path, intrinsics: NDArray[np.float64], height: int, width: int) -> NDArray[np.float64]:
    """Refuse matrices that are not ``[[fx, s, cx], [0, fy, cy], [0, 0, 1]]`` in pixels of this image size."""
    if not np.isfinite(intrinsics).all():
        raise refuse(path, "not_finite", "'intrinsics' is not finite")
    if not (
        np.array_equal(intrinsics[..., 2, :], np.broadcast_to([0.0, 0.0, 1.0], intrinsics[..., 2, :].shape))
        and (intrinsics[..., 1, 0] == 0).all()
    ):
        raise refuse(path, "intrinsics_matrix", "'intrinsics' is not [[fx, s, cx], [0, fy, cy], [0, 0, 1]]")
    focal = np.stack([intrinsics[..., 0, 0] / width, intrinsics[..., 1, 1] / height])
    if focal.min() < _FOCAL_RANGE[0] or focal.max() > _FOCAL_RANGE[1]:
        worst = f"{intrinsics[..., 0, 0].min():.4g}, {intrinsics[..., 1, 1].min():.4g}"
        raise refuse(
            path,
            "focal_length",
            f"'intrinsics' has focal lengths ({worst}) that do not fit {width}x{height} images "
            "(are they in pixels, and positive?)",
        )
    center = np.stack([intrinsics[..., 0, 2] / width, intrinsics[..., 1, 2] / height])
    if np.abs(center - 0.5).max() > 2.0:
        raise refuse(
            path, "principal_point", "'intrinsics' has its principal point far outside the image (is it in pixels?)"
        )
    return intrinsics


def check_poses(path: Path, cam_to_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Refuse matrices that are not rigid camera-to-world poses: finite, last row 0 0 0 1, orthonormal, right-handed."""
    if not np.isfinite(cam_to_world).all():
        raise refuse(path, "not_finite", "'cam_to_world' is not finite")
    if not np.allclose(cam_to_world[..., 3, :], [0, 0, 0, 1], atol=1e-9, rtol=0):
        raise refuse(path, "transposed_pose", "'cam_to_world' does not end in the row 0 0 0 1 (is it transposed?)")
    rotation = cam_to_world[..., :3, :3]
    clipped = np.clip(rotation, -2, 2)  # so that absurd values do not overflow
    error = np.abs(clipped @ np.swapaxes(clipped, -1, -2) - np.eye(3)).max()
    if error > _ORTHONORMAL_TOLERANCE:
        raise refuse(
            path, "not_orthonormal_pose", f"'cam_to_world' holds rotations that are not orthonormal (error {error:.2g})"
        )
    if (np.linalg.det(rotation) < 0).any():
        raise refuse(
            path,
            "left_handed_pose",
            "'cam_to_world' is left-handed (determinant -1); OpenCV axes are x right, y down, z forward",
        )
    return cam_to_world
