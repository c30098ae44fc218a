"""Pixels that hang in the air between what lies before and behind them in a picture."""

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray
from scipy.spatial import cKDTree

_SUPPORT_REACH, _MIN_SUPPORT = 4.0, 4
"""Widths of a pixel within which a point of a surface has so many others, in any view."""

_HALF_OF_NEIGHBOURS = ((0, 1), (1, -1), (1, 0), (1, 1))


def hangs_alone(
    points: Float[NDArray[np.floating], "view height width 3"],
    valid: Bool[NDArray[np.bool_], "view height width"],
    footprints: Float[NDArray[np.floating], "view height width"],
) -> Bool[NDArray[np.bool_], "view height width"]:
    """Return valid pixels that have hardly any others near them in space, points of all views together.

    Between what lies before and behind them in a picture they hang in the air; a body that meets one is thrown off its
    way. ``footprints`` are the widths of pixels at their depth, metres.
    """
    alone, reach = np.zeros_like(valid), _SUPPORT_REACH * footprints
    # Most have enough beside them in their own picture, which is soon counted; space is searched for the others alone.
    unsure = valid & (_num_beside(points, valid, reach) < _MIN_SUPPORT)
    if unsure.any():
        # Itself among them, so many lie within reach unless the next one does not: to count all takes thrice as long.
        tree, limit = cKDTree(points[valid], balanced_tree=False), np.nextafter(reach[unsure].max(), np.inf)
        distance, _ = tree.query(points[unsure], k=[_MIN_SUPPORT + 1], distance_upper_bound=limit)
        alone[unsure] = distance[:, 0] > reach[unsure]
    return alone


def _num_beside(
    points: NDArray[np.floating], valid: NDArray[np.bool_], reach: NDArray[np.floating]
) -> UInt8[NDArray[np.uint8], "view height width"]:
    """Return how many of the eight neighbours in its picture lie within the reach of each pixel."""
    counts = np.zeros(valid.shape, np.uint8)
    height, width = valid.shape[1:]
    axes = np.moveaxis(points, -1, 0)
    for down, across in _HALF_OF_NEIGHBOURS:
        one = np.s_[..., : height - down, max(-across, 0) : width - max(across, 0)]
        other = np.s_[..., down:, max(across, 0) : width + min(across, 0)]
        distance = np.sqrt(sum((axis[one] - axis[other]) ** 2 for axis in axes))
        both = valid[one] & valid[other]
        counts[one] += both & (distance <= reach[one])
        counts[other] += both & (distance <= reach[other])
    return counts
