"""OpenCV's lens model: k1 k2 p1 p2 k3 and, with eight numbers, k4 k5 k6."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_MAX_ITERATIONS = 200
_TOLERANCE = 1e-12  # in units of the focal length: far below a millionth of a pixel


def distort(x: Array, y: Array, distortion: Array) -> tuple[Array, Array]:
    """Return where rays ``x/z``, ``y/z`` appear through the lens, in the same units."""
    radial, shift_x, shift_y = _parts(x, y, distortion)
    return x * radial + shift_x, y * radial + shift_y


def undistort(x: Array, y: Array, distortion: Array) -> tuple[Array, Array]:
    """Return the rays that appear at ``x``, ``y`` through the lens; NaN where the model cannot be inverted.

    A fixed-point iteration, which converges for the lenses that this model describes.
    """
    ray_x, ray_y = x.copy(), y.copy()
    with np.errstate(all="ignore"):
        for _ in range(_MAX_ITERATIONS):
            radial, shift_x, shift_y = _parts(ray_x, ray_y, distortion)
            next_x, next_y = (x - shift_x) / radial, (y - shift_y) / radial
            change = np.maximum(np.abs(next_x - ray_x), np.abs(next_y - ray_y))
            ray_x, ray_y = next_x, next_y
            if not (change > _TOLERANCE).any():
                break
        seen_x, seen_y = distort(ray_x, ray_y, distortion)
        is_good = np.maximum(np.abs(seen_x - x), np.abs(seen_y - y)) < 1e-6
    return np.where(is_good, ray_x, np.nan), np.where(is_good, ray_y, np.nan)


def _parts(x: Array, y: Array, distortion: Array) -> tuple[Array, Array, Array]:
    k1, k2, p1, p2, k3, k4, k5, k6 = [*distortion, 0.0, 0.0, 0.0][:8]
    r = x * x + y * y
    radial = (1 + r * (k1 + r * (k2 + r * k3))) / (1 + r * (k4 + r * (k5 + r * k6)))
    return radial, 2 * p1 * x * y + p2 * (r + 2 * x * x), p1 * (r + 2 * y * y) + 2 * p2 * x * y
