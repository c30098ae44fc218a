"""Compiled loops of the nearest usable point. Import this module only where numba is installed.

Distances are differences, squared and summed in the order x, y, z; of equally far points the first wins. The usable
points of a member are copied column by column, so that the loop over them is vectorised.
"""

from typing import no_type_check

import numba
import numpy as np


@numba.njit(nogil=True, cache=True)
@no_type_check  # keeps the type checker of the tests from wrapping what numba compiles
def nearest(queries, points, usable, own, other, index, exists, has_kinds):
    """Fill ``index`` and ``exists`` (member, query) for members of a batch; see ``nearest.nearest_usable``."""
    num_points = points.shape[1]
    columns = np.empty((3, num_points), queries.dtype)
    kinds = np.empty(num_points, np.int64)
    names = np.empty(num_points, np.int64)
    squares = np.empty(num_points, queries.dtype)
    for member in range(len(queries)):
        count = 0
        for point in range(num_points):
            if usable[member, point]:
                for axis in range(3):
                    columns[axis, count] = points[member, point, axis]
                kinds[count], names[count] = other[member, point], point
                count += 1
        for query in range(queries.shape[1]):
            x, y, z = queries[member, query, 0], queries[member, query, 1], queries[member, query, 2]
            for i in range(count):
                dx, dy, dz = x - columns[0, i], y - columns[1, i], z - columns[2, i]
                squares[i] = dx * dx + dy * dy + dz * dz
            best, place, kind = np.inf, -1, own[member, query]
            for i in range(count):
                if squares[i] < best and not (has_kinds and kinds[i] == kind):
                    best, place = squares[i], i
            if place >= 0:
                index[member, query], exists[member, query] = names[place], True
