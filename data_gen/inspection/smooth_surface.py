"""Where a sensor's depth shows a surface that it measures well: away from edges, and not at grazing angles."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from data_gen.inspection.posed_depth import PosedDepth, rays

_WINDOW = 5
"""Pixels across which depth is averaged before normals are taken: one pixel's noise would tilt them anywhere."""

_MAX_STEP = 0.1
"""Share of depth by which neighbours of one surface differ at most."""

_GRAZING = np.tan(np.radians(60.0))
"""Tangent between normal and ray beyond which sensors err by more than they scatter."""


@dataclass(frozen=True)
class SmoothSurface:
    """Normals of an image, in its camera, and which pixels are measured well."""

    normals: Float[NDArray[np.float64], "height width 3"]
    is_sure: Bool[NDArray[np.bool_], "height width"]


def smooth_surface(image: PosedDepth) -> SmoothSurface:
    """Find normals from averaged depth; sure are pixels with depth that lie beside no jump and are not grazed."""
    valid = image.depth > 0
    far = maximum_filter(image.depth, 3)
    near = minimum_filter(np.where(valid, image.depth, np.inf), 3)
    rows, columns = np.indices(image.depth.shape)
    directions = rays(image.intrinsics, columns.ravel(), rows.ravel()).reshape(*image.depth.shape, 3)
    # Inverse depth is linear across a plane: its mean over the window is that of the middle.
    total = uniform_filter(np.where(valid, 1 / np.where(valid, image.depth, 1.0), 0.0).astype(np.float64), _WINDOW)
    share = uniform_filter(valid.astype(np.float64), _WINDOW)
    points = directions * (share / np.maximum(total, 1e-9))[..., None]
    crossed = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    length = np.linalg.norm(crossed, axis=-1)
    normals = crossed / np.maximum(length, 1e-30)[..., None]
    along = np.abs((normals * directions).sum(axis=-1))
    is_grazed = along * np.sqrt(1 + _GRAZING**2) < np.linalg.norm(directions, axis=-1)
    is_whole = np.zeros_like(valid)
    is_whole[_WINDOW // 2 + 1 : -_WINDOW // 2, _WINDOW // 2 + 1 : -_WINDOW // 2] = True  # no window beyond the picture
    return SmoothSurface(normals, valid & is_whole & (length > 0) & (far - near <= _MAX_STEP * far) & ~is_grazed)
