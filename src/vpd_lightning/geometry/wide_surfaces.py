"""Which pixels belong to wide smooth surfaces (floor, walls, table tops): what stands still in most scenes."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

_NUM_TANGENT_PLANES = 4
"""Number of nearest points of a wide surface to whose tangent planes a doubtful point is compared."""

_MIN_STRAIGHTNESS = 0.7071067811865476
"""Cosine of 45 degrees: where a row or column of pixels bends by more between its steps, two surfaces meet."""

_MAX_STEP_RATIO = 4.0
"""Where one step along a row or column of pixels is longer than the next by more, depth jumps: on a plane, steps grow
slowly but for the last two before its horizon. A body's edge may point along the jump, so that directions agree."""

_MAX_SURFACE_POINTS = 2000
"""Points of a wide surface that the search uses: it is locally flat, so these are enough and keep the search cheap."""


def wide_surfaces(
    points: Float[np.ndarray, "view height width 3"],
    normals: Float[np.ndarray, "view height width 3"],
    valid: Bool[np.ndarray, "view height width"],
    footprints: Float[np.ndarray, "view height width"],
    *,
    max_slope: float,
    max_turn: float,
    min_width: float,
    tolerance: float,
) -> Bool[np.ndarray, "view height width"]:
    """Return which valid pixels lie on a surface that is smooth and wide.

    Neighbouring pixels are of one surface where the step between their points leaves both tangent planes by no more
    than ``max_slope`` of its length and their normals differ by no more than ``max_turn`` (a cosine). Where a row
    or column of pixels bends sharply, a pixel is linked with none: normals along a seam lie between those of its two
    sides, and where the seam crosses rows of pixels at a small angle they change so slowly that one side leads to the
    other. A surface is wide where the diagonal of its bounding box is at least ``min_width`` of that of all valid
    points. What is left over belongs to it, too, if its point lies within ``tolerance`` footprints (metres that a pixel
    covers) of the tangent plane of a near point of it, from whatever view: image borders, and the seam at the foot of a
    body.

    One time step is enough, cameras may move, and no orientation is assumed: walls are found as well as floors.
    """
    shape = valid.shape
    index = np.arange(valid.size).reshape(shape)
    flat, flat_normals, flat_valid = points.reshape(-1, 3), normals.reshape(-1, 3), valid.reshape(-1)
    senders = np.concatenate([index[:, :, :-1].ravel(), index[:, :-1].ravel()])
    receivers = np.concatenate([index[:, :, 1:].ravel(), index[:, 1:].ravel()])
    usable = flat_valid[senders] & flat_valid[receivers]
    senders, receivers = senders[usable], receivers[usable]
    steps = flat[receivers] - flat[senders]
    limit = max_slope * np.sqrt(_dot(steps, steps))
    ends = flat_normals[senders], flat_normals[receivers]
    smooth = _dot(*ends) > max_turn
    for normal in ends:
        smooth &= np.abs(_dot(normal, steps)) < limit
    bent = _bent(points, valid).ravel()
    smooth &= ~(bent[senders] | bent[receivers])
    links = coo_array((np.ones(smooth.sum(), bool), (senders[smooth], receivers[smooth])), shape=(valid.size,) * 2)
    _, labels = connected_components(links, directed=False)
    wide = _is_wide(flat, flat_valid, labels, min_width)
    doubtful = flat_valid & ~wide
    if wide.any() and doubtful.any():
        wide[doubtful] = _on_planes(flat, flat_normals, wide, doubtful, footprints.reshape(-1), tolerance)
    return wide.reshape(shape)


def _dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i", first, second)  # several times faster than a product and a sum of three


def _bent(points: np.ndarray, valid: np.ndarray) -> Bool[np.ndarray, "view height width"]:
    """Mark the pixels between whose neighbours a row or column of pixels changes its direction too much."""
    bent = np.zeros_like(valid)
    for axis in (1, 2):
        along, there, found = (np.moveaxis(values, axis, 1) for values in (points, valid, bent))
        steps = along[:, 1:] - along[:, :-1]
        lengths = np.sqrt(_dot(steps, steps))
        before, after = lengths[:, :-1], lengths[:, 1:]
        turns = _dot(steps[:, 1:], steps[:, :-1]) < _MIN_STRAIGHTNESS * before * after
        jumps = np.maximum(before, after) > _MAX_STEP_RATIO * np.minimum(before, after)
        found[:, 1:-1] |= (turns | jumps) & there[:, 2:] & there[:, :-2]
    return bent


def _is_wide(points: np.ndarray, valid: np.ndarray, labels: np.ndarray, min_width: float) -> Bool[np.ndarray, " point"]:
    """Mark the points whose surface reaches far enough."""
    if not valid.any():
        return np.zeros_like(valid)
    # Surfaces of one pixel are many and never wide.
    large = valid & (np.bincount(labels)[labels] > 1)
    order = np.argsort(labels[large], kind="stable")
    grouped, names = points[large][order].T, labels[large][order]
    if not len(names):
        return np.zeros_like(valid)
    starts = np.flatnonzero(np.r_[True, names[1:] != names[:-1]])
    # One axis after the other: over three columns at once the same reductions take ten times as long.
    square = sum((np.maximum.reduceat(x, starts) - np.minimum.reduceat(x, starts)) ** 2 for x in grouped)
    whole = sum((x.max() - x.min()) ** 2 for x in points[valid].T)
    is_wide = np.zeros(labels.max() + 1, dtype=bool)
    is_wide[names[starts]] = square >= max(min_width**2 * whole, np.finfo(float).tiny)
    return is_wide[labels] & valid


def _on_planes(
    points: np.ndarray,
    normals: np.ndarray,
    wide: np.ndarray,
    doubtful: np.ndarray,
    footprints: np.ndarray,
    tolerance: float,
) -> Bool[np.ndarray, " doubtful"]:
    surface = np.flatnonzero(wide)
    surface = surface[:: max(1, len(surface) // _MAX_SURFACE_POINTS)]
    count = min(_NUM_TANGENT_PLANES, len(surface))
    _, near = cKDTree(points[surface]).query(points[doubtful], k=[*range(1, count + 1)])
    near = surface[near]
    heights = _dot(points[doubtful][:, None] - points[near], normals[near])
    return np.abs(heights).min(axis=1) < tolerance * footprints[doubtful]
