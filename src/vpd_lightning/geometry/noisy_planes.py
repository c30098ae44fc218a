"""Which pixels lie on wide planes where depth is noisy: planes fitted to all views, thresholds from the noise found."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vpd_lightning.geometry.hanging_points import hangs_alone

_STEP = 3
"""Pixels between the three depths that are compared to find noise: neighbours err alike, so nearer ones hide it."""

_NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

_NUM_SAMPLED, _NUM_TRIALS, _MAX_PLANES = 3000, 400, 6
_TRIALS_AT_ONCE = 16
"""So few that the distances of all sampled points from their planes stay in the processor's cache."""

_INLIER = 2.5
"""Standard deviations within which a point supports a plane."""

_MIN_SHARE = 0.03
"""Share of all points that a plane must hold."""

_LARGE_SHARE, _LARGE_WIDTH = 0.1, 0.6
"""Share of all points with which a plane need reach this share of ``min_width`` only: a table before a far wall."""

_NUM_BINS, _MIN_IN_BIN = 24, 20
"""Bins of distance in which bias and noise of a plane are estimated, and the fewest pixels for an estimate."""

_MOVING_COST = 3.4
"""Cost of labelling a pixel as on no plane, in nats: on its own it must be 2.6 standard deviations off."""

_MAX_COST = 12.0
_COUPLING = 1.2
"""Cost of differing from one of eight neighbours, in nats."""

_NEIGHBOURS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
_ALIKE = 3.0
"""Standard deviations that neighbours may differ by and pull at each other; a body and what is behind it do not."""

_FAR = 1e9  # whose square is a number
_MIN_ALIKE = 2
_MAX_STEEPNESS = 4.0
"""Neighbours of its own surface that a pixel of a body has; tangent to the rays up to which they are of its surface."""

_NUM_ROUNDS = 8
_MIN_PIXELS = 5
_MIN_DEVIATIONS = 3.0
"""Pixels of a body, and their median distance from the planes in standard deviations; less is a patch of noise."""

_RIM_LENGTH = 2.0
"""How many times as long as it is high a strip behind the edge of a plane is the plane's rim."""

_SMALL, _MIN_DEVIATIONS_OF_SMALL = 20, 4.5
"""With fewer pixels than this it must be farther off: neighbours err alike, so noise comes in patches of about ten."""


@dataclass(frozen=True)
class _Views:
    """Pixels of all views. A plane's inverse depth is that of its normal form, so that no point has to be moved."""

    depth: Float[NDArray[np.float64], "view height width"]
    rays: Float[NDArray[np.float64], "view height width 3"]  # world, one unit along the optical axis
    centers: Float[NDArray[np.float64], "view 3"]
    valid: Bool[NDArray[np.bool_], "view height width"]

    @property
    def points(self) -> Float[NDArray[np.float64], "view height width 3"]:
        return self.centers[:, None, None] + self.rays * self.depth[..., None]

    def residuals(self, plane: NDArray[np.float64]) -> Float[NDArray[np.float64], "view height width"]:
        """Return by what share of its depth each pixel lies behind a plane (normal, height); infinite where none is."""
        normal, height = plane[:3], plane[3]
        nearness = (self.rays @ normal) / _not_zero(height - self.centers @ normal)[:, None, None]
        with np.errstate(over="ignore"):
            return np.where(self.valid & (nearness > 0), self.depth * nearness - 1, np.inf)


def relative_noise(
    depth: Float[np.ndarray, "view height width"], valid: Bool[np.ndarray, "view height width"]
) -> Float[np.ndarray, " view"]:
    """Return the median noise of each view as a share of depth; 0 where too little is seen.

    The inverse depth of a plane is linear in the picture. The second differences of most pixels, which show surfaces
    that hardly bend, are noise; the median does not see the others.
    """
    found = np.zeros(len(depth))
    for view, (one, there) in enumerate(zip(depth, valid, strict=True)):
        nearness = np.where(there, 1 / np.where(there, one, 1.0), np.nan)
        parts = []
        for lines in (nearness, nearness.T):
            if lines.shape[0] > 2 * _STEP:
                middle = lines[_STEP:-_STEP]
                bend = (lines[2 * _STEP :] - 2 * middle + lines[: -2 * _STEP]) / middle
                parts.append(bend[np.isfinite(bend)])
        every = np.concatenate(parts) if parts else np.empty(0)
        if every.size >= _MIN_IN_BIN:
            found[view] = _NORMAL_MAD * np.median(np.abs(every)) / np.sqrt(6)
    return found


def off_wide_planes(
    depth: Float[np.ndarray, "view height width"],
    rays: Float[np.ndarray, "view height width 3"],
    centers: Float[np.ndarray, "view 3"],
    valid: Bool[np.ndarray, "view height width"],
    noise: Float[np.ndarray, " view"],
    pixel_sizes: Float[np.ndarray, " view"],
    *,
    min_width: float,
) -> Bool[np.ndarray, "view height width"] | None:
    """Return which valid pixels lie on no wide plane; None where no wide plane is found.

    Planes are fitted by RANSAC to the points of all views together; one counts where it holds many points and reaches
    ``min_width`` of the diagonal of all that is seen (less where it holds a tenth of all points). For each plane, view
    and distance its bias and noise are found anew: at grazing angles a sensor errs by more than it scatters. How many
    standard deviations a pixel lies off its nearest plane, and the labels of its neighbours (mean field of a Potts
    model), decide. ``rays`` are one unit along the optical axis, in the world; ``noise`` is a share of depth
    (``relative_noise``), and so is ``pixel_sizes``, what a pixel covers.
    """
    views = _Views(depth.astype(np.float64), rays.astype(np.float64), centers.astype(np.float64), valid)
    if valid.sum() < _MIN_IN_BIN:
        return None
    planes = _wide_planes(views, noise, min_width)
    if not planes:
        return None
    judged = [_deviations(views, plane, noise) for plane in planes]
    every = np.stack([deviations for deviations, _ in judged])
    nearest = np.abs(every).argmin(axis=0)[None]
    signed, scatters = (np.take_along_axis(np.stack(parts), nearest, axis=0)[0] for parts in zip(*judged, strict=True))
    normals, heights = np.stack(planes)[nearest[0]][..., :3], np.stack(planes)[nearest[0]][..., 3]
    points = views.points
    beside = np.abs((points * normals).sum(axis=-1) - heights)  # metres
    result = np.zeros_like(valid)
    for view, there in enumerate(valid):
        moving = _settled(signed[view], there)
        reach = np.maximum(_ALIKE * np.sqrt(2) * scatters[view], _MAX_STEEPNESS * pixel_sizes[view])
        with np.errstate(invalid="ignore"):
            shares = signed[view] * scatters[view]
            moving = _without_flying(moving, shares, views.depth[view], reach)
            moving = _without_specks(moving, np.abs(signed[view]))
            result[view] = moving & ~_rims(moving & (shares > 0), shares, reach, points[view], beside[view])
    # What lies beside a body in the picture alone, and half a metre off, would drag it along where it meets the floor.
    return result & ~hangs_alone(points, result, views.depth * pixel_sizes[:, None, None])


def _wide_planes(views: _Views, noise: NDArray[np.float64], min_width: float) -> list[NDArray[np.float64]]:
    points, where = views.points[views.valid], np.nonzero(views.valid)[0]
    depth, scatter = views.depth[views.valid], np.maximum(noise, noise[noise > 0].min(initial=1.0))
    sigma = scatter[where] * depth  # metres along the ray
    draw = np.random.default_rng(0)
    chosen = draw.permutation(len(points))[:_NUM_SAMPLED]
    whole = np.linalg.norm(np.ptp(points, axis=0))
    rays = views.rays[views.valid]
    free, planes = np.ones(len(points), bool), []
    for _ in range(_MAX_PLANES):
        pool = chosen[free[chosen]]
        if len(pool) < max(_MIN_IN_BIN, _MIN_SHARE * len(chosen)):
            break
        plane = _ransac(points[pool], rays[pool], sigma[pool], draw)
        left, left_rays, left_sigma = points[free], rays[free], sigma[free]
        inside = np.zeros(len(left), bool)
        for _ in range(3):  # the fit of all that supports it
            inside = np.abs(_along(plane, left, left_rays)) < _INLIER * left_sigma
            if inside.sum() < _MIN_IN_BIN:
                break
            plane = _fit(left[inside], 1 / left_sigma[inside])
        if inside.sum() < _MIN_SHARE * len(points):
            break
        low, high = np.percentile(left[inside], [2, 98], axis=0)
        is_large = inside.sum() >= _LARGE_SHARE * len(points)
        if np.linalg.norm(high - low) >= (_LARGE_WIDTH if is_large else 1.0) * min_width * whole:
            planes.append(plane)
        free[free] = np.abs(_along(plane, left, left_rays)) >= 2 * _INLIER * left_sigma
    return planes


def _ransac(
    points: NDArray[np.float64], rays: NDArray[np.float64], sigma: NDArray[np.float64], draw: np.random.Generator
) -> NDArray[np.float64]:
    corners = points[draw.integers(len(points), size=(_NUM_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    # Single precision is enough to count: noise is a thousand times coarser once places are taken from their middle.
    middle = points.mean(axis=0)
    near, directions, facing = (values.astype(np.float32) for values in (points - middle, rays, normals))
    heights = ((corners[:, 0] - middle) * normals).sum(1).astype(np.float32)
    limit = (_INLIER * sigma).astype(np.float32)
    support = np.empty(_NUM_TRIALS, np.int64)
    for start in range(0, _NUM_TRIALS, _TRIALS_AT_ONCE):
        some = slice(start, start + _TRIALS_AT_ONCE)
        off = np.abs(facing[some] @ near.T - heights[some, None])
        slope = np.abs(facing[some] @ directions.T)
        # Points on the surface of a body beside the plane must not count for it: a plane seen edge-on holds anything.
        support[some] = np.count_nonzero((off < limit * slope) & (slope > 0.05), axis=1)
    best = int(support.argmax())
    return np.append(normals[best], normals[best] @ corners[best, 0])


def _along(plane: NDArray[np.float64], points: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return metres along the rays from the plane to the points."""
    return (points @ plane[:3] - plane[3]) / _not_zero(rays @ plane[:3])


def _fit(points: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    weights = weights**2 / (weights**2).sum()
    middle = weights @ points
    offsets = points - middle
    _, axes = np.linalg.eigh((offsets * weights[:, None]).T @ offsets)
    return np.append(axes[:, 0], axes[:, 0] @ middle)


def _deviations(
    views: _Views, plane: NDArray[np.float64], noise: NDArray[np.float64]
) -> tuple[Float[NDArray[np.float64], "view height width"], Float[NDArray[np.float64], "view height width"]]:
    """Return how many standard deviations pixels lie behind a plane, and what one is as a share of depth.

    Bias and noise are those of view and distance.
    """
    residuals = views.residuals(plane)
    result = np.full(residuals.shape, np.inf)
    scatters = np.broadcast_to(noise[:, None, None], residuals.shape).copy()
    for view, (residual, depth) in enumerate(zip(residuals, views.depth, strict=True)):
        known = np.isfinite(residual)
        if known.sum() < _MIN_IN_BIN or noise[view] == 0:
            continue
        biases, spreads, middles = _by_distance(residual[known], depth[known], noise[view])
        bias, scatters[view] = np.interp(depth, middles, biases), np.interp(depth, middles, spreads)
        result[view] = np.where(known, (residual - bias) / scatters[view], np.inf)
    return result, scatters


def _by_distance(
    residual: NDArray[np.float64], depth: NDArray[np.float64], noise: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return bias, noise (shares of depth) and middles of bins of distance, from the surest one outwards."""
    edges = np.quantile(depth, np.linspace(0, 1, _NUM_BINS + 1))
    number = np.clip(np.searchsorted(edges, depth, side="right") - 1, 0, _NUM_BINS - 1)
    middles = (edges[:-1] + edges[1:]) / 2 + np.arange(_NUM_BINS) * 1e-12
    counts = np.bincount(number, minlength=_NUM_BINS)
    binned = np.split(residual[np.argsort(number, kind="stable")], np.cumsum(counts)[:-1])
    biases, scatters = np.zeros(_NUM_BINS), np.full(_NUM_BINS, noise)
    close = np.bincount(number, np.abs(residual) < _INLIER * noise, _NUM_BINS)
    start = int(np.argmax(close / np.maximum(counts, 1)))
    for order in (range(start, _NUM_BINS), range(start - 1, -1, -1)):
        for each in order:
            beside = each + 1 if each < start else max(each - 1, start)
            bias, scatter = biases[beside], scatters[beside]
            mine = binned[each]
            for _ in range(3):
                inside = mine[np.abs(mine - bias) < 3 * scatter]
                if len(inside) < _MIN_IN_BIN:
                    break
                bias = _median(inside)
                scatter = min(max(_NORMAL_MAD * _median(np.abs(inside - bias)), 0.5 * noise), 3 * noise)
            biases[each], scatters[each] = bias, scatter
    return biases, scatters, middles


def _median(values: NDArray[np.float64]) -> float:
    """Return what ``np.median`` does, which takes four times as long for a few hundred numbers."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    return float(np.partition(values, (middle - 1, middle))[middle - 1 : middle + 1].mean())


def _settled(deviations: NDArray[np.float64], valid: NDArray[np.bool_]) -> Bool[NDArray[np.bool_], "height width"]:
    """Return the pixels that are rather on no plane, given what their neighbours at a like distance are."""
    gain = np.where(valid, np.minimum(deviations**2 / 2, _MAX_COST) - _MOVING_COST, 0.0)
    padded = _padded(deviations, np.inf)
    pulls = [_COUPLING * np.exp(-(_apart(padded, shift) ** 2) / (2 * _ALIKE**2)) for shift in _NEIGHBOURS]
    state = _padded(np.where(valid, np.tanh(gain / 2), 0.0), 0.0)  # and stays zero around the picture
    for _ in range(_NUM_ROUNDS):
        field = gain.copy()
        for pull, shift in zip(pulls, _NEIGHBOURS, strict=True):
            field += pull * _beside(state, shift)
        _beside(state, (0, 0))[:] = np.where(valid, np.tanh(field / 2), 0.0)
    return valid & (_beside(state, (0, 0)) > 0)


def _without_flying(
    moving: NDArray[np.bool_], residuals: NDArray[np.float64], depth: NDArray[np.float64], reach: NDArray[np.float64]
) -> Bool[NDArray[np.bool_], "height width"]:
    """Return moving pixels without those that hang alone between near and far.

    ``reach`` says how far apart neighbours on one surface may be, as a share of their depth: in how far they lie behind
    the plane or, above its horizon, where that is infinite, in the logarithm of their depth.
    """
    values, there = _padded(residuals, np.inf), _padded(moving, False)
    distances = _padded(np.log(np.where(moving, depth, 1.0)), np.inf)
    above_horizon = ~np.isfinite(values)
    alike = np.zeros(moving.shape, np.int64)
    for each in _NEIGHBOURS:
        either_above = _beside(above_horizon, (0, 0)) | _beside(above_horizon, each)
        apart = np.where(either_above, _apart(distances, each), _apart(values, each))
        alike += (apart < reach) & _beside(there, each)
    return moving & (alike >= _MIN_ALIKE)


def _padded(values: NDArray[Any], outside: float) -> NDArray[Any]:
    return np.pad(values, 1, constant_values=outside)


def _beside(padded: NDArray[Any], shift: tuple[int, int]) -> NDArray[Any]:
    """Return a view of each pixel's neighbour."""
    (rows, columns), (height, width) = shift, padded.shape
    return padded[1 + rows : height - 1 + rows, 1 + columns : width - 1 + columns]


def _apart(padded: NDArray[np.float64], shift: tuple[int, int]) -> NDArray[np.float64]:
    """Return how far each pixel's value is from its neighbour's; far where one of the two is infinite."""
    with np.errstate(invalid="ignore"):
        apart = np.abs(_beside(padded, (0, 0)) - _beside(padded, shift))
    apart[~np.isfinite(apart)] = _FAR
    return apart


def _without_specks(moving: NDArray[np.bool_], deviations: NDArray[np.float64]) -> Bool[NDArray[np.bool_], "h w"]:
    names, count = label(moving, structure=np.ones((3, 3)))
    kept = np.zeros(count + 1, bool)
    for name in range(1, count + 1):
        mine = deviations[names == name]
        limit = _MIN_DEVIATIONS_OF_SMALL if len(mine) < _SMALL else _MIN_DEVIATIONS
        kept[name] = len(mine) >= _MIN_PIXELS and np.median(mine) >= limit
    return kept[names]


def _rims(
    behind: NDArray[np.bool_],
    residuals: NDArray[np.float64],
    reach: NDArray[np.float64],
    points: NDArray[np.float64],
    beside: NDArray[np.float64],
) -> Bool[NDArray[np.bool_], "height width"]:
    """Return the pixels of long strips along a plane, close behind it: the sides of a table top.

    ``behind`` are moving pixels behind their nearest plane, ``beside`` their distance from it (metres). What stands on
    a plane lies in front of it, and what falls past its edge is as high as it is long.
    """
    result = np.zeros_like(behind)
    number = np.full(behind.shape, -1)
    number[behind] = np.arange(behind.sum())
    values, numbers = _padded(residuals, np.inf), _padded(number, -1)
    pairs = []
    for shift in _NEIGHBOURS[:4]:
        joined = behind & (_beside(numbers, shift) >= 0) & (_apart(values, shift) < reach)
        pairs.append(np.stack([number[joined], _beside(numbers, shift)[joined]]))
    ends = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(ends.shape[1]), (ends[0], ends[1])), shape=(behind.sum(),) * 2)
    count, names = connected_components(graph, directed=False)
    places, depths, is_rim = points[behind], beside[behind], np.zeros(count, bool)
    for name in range(count):
        mine = names == name
        low, high = np.percentile(places[mine], [5, 95], axis=0)
        is_rim[name] = np.linalg.norm(high - low) > _RIM_LENGTH * np.percentile(depths[mine], 90)
    result[behind] = is_rim[names]
    return result


def _not_zero(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.abs(values) < 1e-12, 1e-12, values)
