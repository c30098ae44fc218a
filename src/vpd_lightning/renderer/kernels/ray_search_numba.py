"""The compiled twin of the ray search for CPUs: only blocks of particles that can hold one of the best are scored.

Particles lie in Morton order in blocks, blocks in groups, and each has a bounding sphere. A sphere bounds the score of
all that is in it from below. What the previous ray found, scored again for this ray, bounds the score of the last
candidate from above. Rays are taken in Morton order of what they pass through, so that neighbours find nearly the same:
almost every sphere is passed over, and almost nothing is inserted that does not stay.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.graph.ordering import build_blocks, morton_order
from vpd_lightning.renderer.rays.ray_scores import BesideRay, RayScore
from vpd_lightning.threads import in_threads

_BLOCK = 16
"""Particles of a block, and blocks of a group."""

_MAX_SLICES, _MIN_SLICE = 16, 128
"""Rays are cut into runs, whatever the number of threads; each run starts without a previous ray."""

_BESIDE, _FIRST, _BEHIND = 0, 1, 2
"""What is scored: ``BesideRay``; the ``first`` of ``BesideAndBehind``; ``BesideAndBehind`` itself."""


@dataclass(frozen=True)
class Prepared:
    """Particles ``block, axis, slot``, their indices, spheres of blocks ``group, xyzr, slot`` and of groups ``xyzr``.

    What only fills a block or a group is NaN: it compares false with everything and is never found.
    """

    points: np.ndarray
    index: np.ndarray
    blocks: np.ndarray
    groups: np.ndarray


def prepared(positions: Float[Tensor, "particle 3"], valid: Bool[Tensor, " particle"]) -> Prepared:
    """Sort the valid particles into blocks and bound them by spheres."""
    names = valid.nonzero().squeeze(-1)
    ordered = build_blocks(positions.index_select(0, names), _BLOCK)
    points = ordered.points.numpy()
    groups = np.ascontiguousarray(_spheres(points, _BLOCK * _BLOCK).T)
    return Prepared(
        _filled(points, _BLOCK), names[ordered.order].numpy(), _filled(_spheres(points, _BLOCK), _BLOCK), groups
    )


def _filled(rows: np.ndarray, size: int) -> np.ndarray:
    """Cut rows into ``block, column, slot``; the last block is filled with NaN."""
    num_blocks = -(-len(rows) // size)
    filled = np.full((num_blocks * size, rows.shape[1]), np.nan, dtype=rows.dtype)
    filled[: len(rows)] = rows
    return np.ascontiguousarray(filled.reshape(num_blocks, size, rows.shape[1]).transpose(0, 2, 1))


def _spheres(points: np.ndarray, size: int) -> np.ndarray:
    """Return centre and radius of a sphere around every ``size`` points, ``block, xyzr``."""
    starts = np.arange(0, len(points), size)
    if not len(starts):
        return np.zeros((0, 4), dtype=points.dtype)
    center = np.minimum.reduceat(points, starts) / 2 + np.maximum.reduceat(points, starts) / 2
    squared = np.square(points - np.repeat(center, size, axis=0)[: len(points)]).sum(axis=1)
    radius = np.sqrt(np.maximum.reduceat(squared, starts))
    return np.concatenate([center, radius[:, None]], axis=1)


def search(
    particles: Sequence[Prepared],
    origins: Float[Tensor, "batch ray 3"],
    directions: Float[Tensor, "batch ray 3"],
    score: RayScore,
    index: Int64[Tensor, "batch ray candidate"],
    mask: Bool[Tensor, "batch ray candidate"],
) -> None:
    """Write the best particles of each ray into ``index`` and ``mask``, best first; ``particles`` per batch member."""
    num_rays = origins.shape[1]
    num_slices = max(1, min(_MAX_SLICES, num_rays // _MIN_SLICE))
    bounds = [num_rays * part // num_slices for part in range(num_slices + 1)]
    # One point on each ray measures how near rays are to each other, for cameras that are some way apart.
    orders = [morton_order(o + d).numpy() for o, d in zip(origins, directions, strict=True)]
    o, d = origins.contiguous().numpy(), directions.contiguous().numpy()
    indices, masks = index.numpy(), mask.numpy()

    def run(task: tuple[int, int]) -> None:
        member, part = task
        p, order = particles[member], orders[member][bounds[part] : bounds[part + 1]]
        given = p.points, p.index, p.blocks, p.groups, order, o[member], d[member]
        _scored_search(given, score, indices[member], masks[member])

    tasks = [(member, part) for member in range(len(particles)) for part in range(num_slices)]
    in_threads(run, tasks)


def _scored_search(given: tuple[np.ndarray, ...], score: RayScore, index: np.ndarray, mask: np.ndarray) -> None:
    dtype, num_rays = given[0].dtype, len(index)
    slack = dtype.type(100 * np.finfo(dtype).eps)
    first = np.zeros(num_rays, dtype)
    if isinstance(score, BesideRay):
        _search(*given, _limits(dtype, score.near, score.far, 0.0, 0.0), slack, _BESIDE, first, index, mask)
        return
    limits = _limits(dtype, score.near, 0.0, score.width**2, score.steepness)
    _search(*given, limits, slack, _FIRST, first, np.zeros((num_rays, 1), np.int64), np.zeros((num_rays, 1), np.bool_))
    _search(*given, limits, slack, _BEHIND, first + dtype.type(score.depth), index, mask)


def _limits(dtype: np.dtype, near: float, far: float, width: float, beside: float) -> tuple[np.floating, ...]:
    return tuple(dtype.type(value) for value in (near, far, width, beside, 0.04, 0.0, np.nan, np.inf))


# Products and sums are never contracted (no fastmath): a particle has the same score wherever it is computed.
# All numbers are arguments of one type: a literal would turn float32 into float64.


@numba.njit(nogil=True, cache=True, inline="always")
@no_type_check  # numba compiles the bare function, not one wrapped by a type checker
def _score(kind, beside, along, limits, first):
    """Score one particle; NaN where it is left out."""
    near, far, width, steep, weight, zero, nan, _ = limits
    if kind == _BESIDE:
        return beside if along >= near and along <= far else nan
    if not along >= near:
        return nan
    if kind == _FIRST:
        wide = beside - width
        return along + steep * (wide if wide > zero else zero)
    behind = along - first
    behind = behind if behind > zero else zero
    return beside + weight * (behind * behind)


@numba.njit(nogil=True, cache=True)
@no_type_check  # numba compiles the bare function, not one wrapped by a type checker
def _score_all(kind, points, o, d, limits, first, scores):
    """Score the particles ``axis, slot`` of a block."""
    ox, oy, oz = o
    dx, dy, dz = d
    for slot in range(scores.shape[0]):
        x, y, z = points[0, slot] - ox, points[1, slot] - oy, points[2, slot] - oz
        along = x * dx + y * dy + z * dz
        x, y, z = x - along * dx, y - along * dy, z - along * dz
        scores[slot] = _score(kind, x * x + y * y + z * z, along, limits, first)


@numba.njit(nogil=True, cache=True)
@no_type_check  # numba compiles the bare function, not one wrapped by a type checker
def _bound_all(kind, spheres, o, d, limits, first, slack, bounds):
    """Bound from below the scores of what lies in spheres ``xyzr, slot``; NaN where all of it is left out."""
    near, far, _, _, _, zero, nan, _ = limits
    ox, oy, oz = o
    dx, dy, dz = d
    for slot in range(bounds.shape[0]):
        x, y, z = spheres[0, slot] - ox, spheres[1, slot] - oy, spheres[2, slot] - oz
        along = x * dx + y * dy + z * dz
        x, y, z = x - along * dx, y - along * dy, z - along * dz
        beside = np.sqrt(x * x + y * y + z * z)
        # The radius, and what rounding may have done to the sphere and to a score.
        reach = spheres[3, slot] + slack * (spheres[3, slot] + beside + abs(along))
        beside = beside - reach
        beside = beside if beside > zero else zero
        if kind == _BESIDE:
            is_there = along + reach >= near and along - reach <= far
            bounds[slot] = beside * beside if is_there else nan
        else:
            # Scores rise with the distance along the ray: the least is where the sphere begins, or at near.
            nearest = along - reach if along - reach > near else near
            bound = _score(kind, beside * beside, nearest, limits, first)
            bounds[slot] = bound if along + reach >= near else nan


@numba.njit(nogil=True, cache=True)
@no_type_check  # numba compiles the bare function, not one wrapped by a type checker
def _insert(score, slot, best, slots):
    """Put a particle into the sorted best; of equal scores the one of lower slot comes first."""
    place = best.shape[0] - 1
    while place > 0 and (best[place - 1] > score or (best[place - 1] == score and slots[place - 1] > slot)):
        best[place] = best[place - 1]
        slots[place] = slots[place - 1]
        place -= 1
    best[place] = score
    slots[place] = slot


@numba.njit(nogil=True, cache=True)
@no_type_check  # numba compiles the bare function, not one wrapped by a type checker
def _bound_of_last(kind, points, slots, o, d, limits, first, again, scores):
    """Return the worst score of some particles, which as many best ones cannot exceed; infinite for no bound."""
    for place in range(slots.shape[0]):
        if slots[place] < 0:
            return limits[7]
        for axis in range(3):
            again[axis, place] = points[slots[place] // _BLOCK, axis, slots[place] % _BLOCK]
    _score_all(kind, again, o, d, limits, first, scores)
    worst = scores[0]
    for place in range(slots.shape[0]):
        if not scores[place] <= worst:
            worst = scores[place]
        if worst != worst:  # left out for this ray
            return limits[7]
    return worst


@numba.njit(nogil=True, cache=True)
@no_type_check  # numba compiles the bare function, not one wrapped by a type checker
def _search(points, names, blocks, groups, order, origins, directions, limits, slack, kind, first, index, mask):
    count = index.shape[1]
    best, slots = np.empty(count, origins.dtype), np.full(count, -1, np.int64)
    group_bounds = np.empty(groups.shape[1], origins.dtype)
    block_bounds, scores = np.empty(_BLOCK, origins.dtype), np.empty(_BLOCK, origins.dtype)
    again, again_scores = np.empty((3, count), origins.dtype), np.empty(count, origins.dtype)
    last = count - 1
    for ray in order:
        o = (origins[ray, 0], origins[ray, 1], origins[ray, 2])
        d = (directions[ray, 0], directions[ray, 1], directions[ray, 2])
        f = first[ray]
        worst = _bound_of_last(kind, points, slots, o, d, limits, f, again, again_scores)
        best[:] = np.inf
        slots[:] = -1
        _bound_all(kind, groups, o, d, limits, f, slack, group_bounds)
        for group in range(groups.shape[1]):
            if not group_bounds[group] <= worst:
                continue
            _bound_all(kind, blocks[group], o, d, limits, f, slack, block_bounds)
            for part in range(_BLOCK):
                if not block_bounds[part] <= worst:
                    continue
                block = group * _BLOCK + part
                _score_all(kind, points[block], o, d, limits, f, scores)
                for slot in range(_BLOCK):
                    if not scores[slot] <= worst:
                        continue
                    name = block * _BLOCK + slot
                    if scores[slot] < best[last] or (scores[slot] == best[last] and name < slots[last]):
                        _insert(scores[slot], name, best, slots)
                        worst = min(worst, best[last])
        if kind == _FIRST:
            first[ray] = best[0]
        for place in range(count):
            mask[ray, place] = slots[place] >= 0
            index[ray, place] = names[slots[place]] if slots[place] >= 0 else 0
