"""Exact search on the CPU in compiled loops over a tree of boxes: the fast choice there wherever numba is installed."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vpd_lightning.errors import ConfigError
from vpd_lightning.graph.neighbors.contract import Neighbors, measured, squared_norm
from vpd_lightning.graph.ordering import build_blocks, morton_order
from vpd_lightning.threads import in_threads

_QUERIES_PER_SLICE = 8192
"""What one thread takes at a time. A slice clears a note per point, so it should not have few queries."""

_SLACK = 1.0 + 1e-6
"""Squares are searched a little beyond the radius, so that no rounding of a root or a square loses a neighbour."""

_COHERENT_STEP = 1 / 16
"""Queries count as coherent when a typical step between two of them is this small a part of their extent."""

_SAMPLED_STEPS = 1024


class NumbaSearch:
    """Holds the points in Morton order in leaves, with boxes over leaves and over boxes.

    Distances equal the reference's to the last bit, and equal distances are ordered by index as there.

    Raises:
        ConfigError: when numba is not installed.
    """

    def __init__(self, points: Float[Tensor, "point 3"]) -> None:
        try:
            from vpd_lightning.graph.neighbors import numba_loops
        except ImportError as error:
            raise ConfigError(
                "neighbors_backend=numba needs the package numba, which is not installed.\n"
                "Install it with `pip install numba`, or use neighbors_backend=auto."
            ) from error
        self._loops = numba_loops
        self._points = points
        # Half precision is searched in float32 and measured again as it came.
        self._dtype = torch.float64 if points.dtype == torch.float64 else torch.float32
        self._leaves, self._members, self._places, self._boxes, self._first_group = _tree(
            points.to("cpu", self._dtype), numba_loops.LEAF, numba_loops.FAN_OUT
        )

    def knn(self, queries: Float[Tensor, "query 3"], k: int, max_radius: float | None) -> Neighbors:
        """Return the ``k`` nearest points, ties broken by index."""
        count, num_queries = min(k, len(self._points)), len(queries)
        searched = queries.to("cpu", self._dtype)
        order = None if _are_coherent(searched) else morton_order(searched)
        if order is not None:
            searched = searched.index_select(0, order)
        index = torch.empty(num_queries, count, dtype=torch.int64)
        distance = torch.empty(num_queries, count, dtype=self._dtype)
        mask = torch.empty(num_queries, count, dtype=torch.bool)
        tree = (self._leaves, self._members, self._places, self._boxes, self._first_group)
        arrays = (searched.contiguous().numpy(), *self._limits(max_radius))
        table = (distance.numpy(), index.numpy(), mask.numpy())
        loop = self._loops.knn_slice
        notes = _in_slices(num_queries, lambda start, stop: loop(*tree, *arrays, start, stop, *table))
        is_doubtful, is_short = (any(note) for note in zip(*notes, strict=True))
        distance.sqrt_()
        if max_radius is not None and is_doubtful:
            mask &= distance <= max_radius
            index.masked_fill_(~mask, 0)
        if is_short or is_doubtful:
            distance.masked_fill_(~mask, torch.inf)
        if order is not None:
            back = torch.empty_like(order).scatter_(0, order, torch.arange(num_queries))
            index, distance, mask = index[back], distance[back], mask[back]
        if self._dtype != self._points.dtype:
            index = index.masked_fill_(~mask, -1).to(queries.device)
            return measured(self._points, queries, index, k, max_radius)
        if count < k:
            index = torch.nn.functional.pad(index, (0, k - count))
            distance = torch.nn.functional.pad(distance, (0, k - count), value=torch.inf)
            mask = torch.nn.functional.pad(mask, (0, k - count))
        return Neighbors(index.to(queries.device), distance.to(queries.device), mask.to(queries.device))

    def radius(
        self, queries: Float[Tensor, "query 3"], max_radius: float
    ) -> tuple[Int64[Tensor, " edge"], Int64[Tensor, " edge"]]:
        """Return all (point, query) pairs within ``max_radius``, sorted by query, then by point."""
        searched = queries.to("cpu", self._dtype).contiguous().numpy()
        tree = (self._leaves, self._members, self._boxes, self._first_group, searched, self._limits(max_radius)[0])
        counts = torch.zeros(len(queries), dtype=torch.int64)
        nothing, counted = np.empty(0, np.int64), counts.numpy()
        loop = self._loops.radius_slice
        _in_slices(len(queries), lambda start, stop: loop(*tree, start, stop, counted, nothing, True))
        ends = counts.cumsum(0)
        senders = torch.empty(int(ends[-1]), dtype=torch.int64)
        ended, filled = ends.numpy(), senders.numpy()
        _in_slices(len(queries), lambda start, stop: loop(*tree, start, stop, ended, filled, False))
        senders = senders.to(queries.device)
        receivers = torch.arange(len(queries)).repeat_interleave(counts).to(queries.device)
        offset = self._points.index_select(0, senders) - queries.index_select(0, receivers)
        within = squared_norm(offset).sqrt_() <= max_radius
        return senders[within], receivers[within]

    def _limits(self, max_radius: float | None) -> tuple[Any, Any]:
        """Return squares that nothing within ``max_radius`` exceeds, and that nothing beyond it stays below."""
        number = np.float64 if self._dtype == torch.float64 else np.float32
        info = torch.finfo(self._dtype)
        largest, smallest = info.max, info.tiny * info.eps
        if max_radius is None:
            return number(largest), number(largest)
        limit = max_radius * max_radius * _SLACK + 2 * smallest
        sure = max_radius * max_radius / _SLACK - 2 * smallest
        return number(min(limit, largest)), number(max(min(sure, largest), 0.0))


def _are_coherent(queries: Float[Tensor, "query 3"]) -> bool:
    """Tell whether neighbours in the list are neighbours in space, from a fixed sample of steps."""
    if len(queries) < 3:
        return True
    first = torch.linspace(0, len(queries) - 2, min(_SAMPLED_STEPS, len(queries) - 1)).long()
    before = queries.index_select(0, first)
    steps = (queries.index_select(0, first + 1) - before).abs().amax(dim=1)
    extent = (before.amax(dim=0) - before.amin(dim=0)).amax()
    return bool(steps.median() <= _COHERENT_STEP * extent)


def _in_slices(count: int, work: Callable[[int, int], Any]) -> list[Any]:
    """Call ``work(start, stop)`` for slices of fixed size, on as many threads as torch uses; return its results."""
    starts = range(0, count, _QUERIES_PER_SLICE)
    return in_threads(lambda start: work(start, min(start + _QUERIES_PER_SLICE, count)), starts)


def _tree(
    points: Float[Tensor, "point 3"], leaf: int, fan_out: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return leaves, members, places, boxes and first groups as ``numba_loops`` describes them."""
    blocks = build_blocks(points, leaf)
    num_leaves = len(blocks.box_min)
    padding = num_leaves * leaf - len(points)
    padded = torch.nn.functional.pad(blocks.points, (0, 0, 0, padding), value=torch.inf)
    leaves = padded.view(num_leaves, leaf, 3).transpose(1, 2).contiguous()
    members = torch.nn.functional.pad(blocks.order, (0, padding)).view(num_leaves, leaf)
    places = torch.empty_like(blocks.order).scatter_(0, blocks.order, torch.arange(len(points)))
    low, high, levels = blocks.box_min, blocks.box_max, []
    while True:
        missing = -len(low) % fan_out
        # A box that starts at infinity is infinitely far from everything.
        far_low = torch.nn.functional.pad(low, (0, 0, 0, missing), value=torch.inf).view(-1, fan_out, 3)
        far_high = torch.nn.functional.pad(high, (0, 0, 0, missing), value=torch.inf).view(-1, fan_out, 3)
        levels.append(torch.stack([far_low, far_high], dim=-1).flatten(2).transpose(1, 2))
        if len(far_low) == 1:
            break
        tail = torch.nn.functional.pad(high, (0, 0, 0, missing), value=-torch.inf).view(-1, fan_out, 3)
        low, high = far_low.amin(dim=1), tail.amax(dim=1)
    first_group = np.cumsum([0, *[len(level) for level in levels[:-1]]])
    return leaves.numpy(), members.numpy(), places.numpy(), torch.cat(levels).contiguous().numpy(), first_group
