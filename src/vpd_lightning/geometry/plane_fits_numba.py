"""Compiled loops of the planes around pixels. Import this module only where numba is installed.

A pixel's neighbours stay in the processor's cache from the first weight to the last fit, where operations on whole
images write each of some thirty results to memory and read it again. Sums may be taken in any order.
"""

import math
from typing import no_type_check

import numba
import numpy as np

_LANES = 8
"""Neighbours are filled up to a multiple of this, with weights of zero, so that loops over them leave no rest."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
@no_type_check  # keeps the type checker of the tests from wrapping what numba compiles
def _median(values, weights, count):
    """Return the weighted median of the first ``count`` values."""
    order = np.argsort(values[:count], kind="mergesort")
    total = weights.dtype.type(0)
    for place in order:
        total += weights[place]
    half, total = total / 2, weights.dtype.type(0)
    for place in order:
        total += weights[place]
        if total >= half:
            return values[place]
    return values[order[-1]]


@numba.njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
@no_type_check
def _sums(values, weights, columns, rows, plane, scale, result):
    """Fill the nine sums of the normal equations, with weights reduced by the distance from ``plane``."""
    first, across, down = plane[0], plane[1], plane[2]
    one, zero = values.dtype.type(1), values.dtype.type(0)
    s, sx, sy, sxx, sxy, syy, v, vx, vy = zero, zero, zero, zero, zero, zero, zero, zero, zero
    inverse = one / scale
    for n in range(len(values)):
        residual = (values[n] - first - across * columns[n] - down * rows[n]) * inverse
        share = one + residual * residual
        r = weights[n] / (share * share)
        rx, ry, rv = r * columns[n], r * rows[n], r * values[n]
        s += r
        sx += rx
        sy += ry
        sxx += rx * columns[n]
        sxy += rx * rows[n]
        syy += ry * rows[n]
        v += rv
        vx += rv * columns[n]
        vy += rv * rows[n]
    result[0], result[1], result[2], result[3], result[4], result[5] = s, sx, sy, sxx, sxy, syy
    result[6], result[7], result[8] = v, vx, vy


@numba.njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _solve(sums, least, ridge, plane):
    """Fill the plane of the normal equations, with ``least`` and ``ridge`` added to the diagonal (Cholesky)."""
    a, b, c = sums[0] + least, sums[1], sums[2]
    d, e, f = sums[3] + ridge, sums[4], sums[5] + ridge
    across = b / a
    down = c / a
    middle = d - b * across
    cross = (e - b * down) / middle
    last = f - c * down - middle * cross * cross
    x, y, z = sums[6], sums[7] - across * sums[6], sums[8] - down * sums[6]
    z -= cross * y
    plane[2] = z / last
    plane[1] = y / middle - cross * plane[2]
    plane[0] = x / a - across * plane[1] - down * plane[2]


@numba.njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def plane_fits(depth, rgb, noise, pixel_size, reach, constants, result):
    """Fill ``result`` (height, width) with the depth of planes; see ``local_planes.plane_depth``.

    ``depth`` is zero where nothing was measured. ``constants`` are those of ``local_planes``: width of the weights,
    scale of colours, jump, robust limit, ridge, rounds, least weight, largest correction; then the negligible exponent.
    """
    width_of_weights, color_scale, jump, robust, ridge, num_rounds, min_weight, max_correction, negligible = constants
    number = depth.dtype.type
    height, width = depth.shape
    side = 2 * reach + 1
    count = side * side
    padded = (count + _LANES - 1) // _LANES * _LANES
    columns, rows = np.zeros(padded, depth.dtype), np.zeros(padded, depth.dtype)
    around, values = np.zeros(padded, depth.dtype), np.zeros(padded, depth.dtype)
    weights, difference = np.zeros(padded, depth.dtype), np.zeros(padded, depth.dtype)
    exponents, color_share = np.zeros(padded, depth.dtype), number(-1 / (2 * color_scale**2))
    for n in range(count):
        rows[n], columns[n] = n // side - reach, n % side - reach
        exponents[n] = -(rows[n] * rows[n] + columns[n] * columns[n]) / (2 * width_of_weights**2)
    # With a frame of pixels that were not measured, so that no neighbour is outside of the picture.
    inverse = np.zeros((height + 2 * reach, width + 2 * reach), depth.dtype)
    colors = np.zeros((3, height + 2 * reach, width + 2 * reach), depth.dtype)
    for y in range(height):
        for x in range(width):
            inverse[y + reach, x + reach] = number(1) / depth[y, x] if depth[y, x] > 0 else number(0)
            for channel in range(3):
                colors[channel, y + reach, x + reach] = rgb[y, x, channel]
    sums, plane, narrow = np.zeros(9), np.zeros(3), np.zeros(3, depth.dtype)
    scale = max(robust * noise, 1e-6)
    wide = max(scale, jump * pixel_size)
    nothing, negligible = number(math.exp(negligible)), number(negligible)
    for y in range(height):
        for x in range(width):
            red, green, blue = rgb[y, x, 0], rgb[y, x, 1], rgb[y, x, 2]
            n, most_alike = 0, number(np.inf)
            for row in range(y, y + side):
                for column in range(x, x + side):
                    around[n] = inverse[row, column]
                    dr = colors[0, row, column] - red
                    dg = colors[1, row, column] - green
                    db = colors[2, row, column] - blue
                    difference[n] = dr * dr + dg * dg + db * db
                    n += 1
            for n in range(count):
                if around[n] > 0 and difference[n] < most_alike:
                    most_alike = difference[n]
            least = min(most_alike, number(1e9))
            for n in range(count):
                exponent = exponents[n] + (difference[n] - least) * color_share
                is_near = around[n] > 0 and exponent > negligible
                weights[n] = np.exp(exponent) if is_near else nothing
            own, is_measured = depth[y, x], depth[y, x] > 0
            start = max(number(1) / own if is_measured else _median(around, weights, count), number(1e-30))
            for n in range(count):
                values[n] = around[n] / start - number(1)
            narrow[:] = 0
            limit = wide
            for _ in range(int(num_rounds)):
                _sums(values, weights, columns, rows, narrow, number(limit), sums)
                _solve(sums, 1e-6, ridge, plane)
                narrow[:] = plane
                limit = scale
            nearness, shift = start * (1 + plane[0]), abs(plane[0])
            if is_measured:
                is_fine = shift < max_correction * noise
            else:
                _sums(values, weights, columns, rows, narrow, number(scale), sums)
                is_near = shift < 2 * max(scale, jump * pixel_size)
                is_fine = sums[0] > min_weight and is_near and most_alike < (3 * color_scale) ** 2
            result[y, x] = own
            if is_fine:
                result[y, x] = 1 / nearness if nearness > 0 else 0
