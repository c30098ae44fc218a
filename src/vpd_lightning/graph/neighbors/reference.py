"""Brute force in plain PyTorch, in chunks: the definition of "correct", on any device and in any float type."""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.graph.neighbors.contract import Neighbors, padded

_PAIRS_PER_CHUNK = {"cpu": 1 << 20, "cuda": 1 << 26}
"""How many distances live at once: 4 MiB of float32 stay in a CPU's cache, 256 MiB keep a GPU busy."""

_FEW = 4
"""Up to here repeated argmin is faster than topk, and it breaks ties by index by itself."""


class ReferenceSearch:
    """Compares each query with every point.

    No ``torch.cdist``: its matrix-product form loses the digits that the kernels live on.
    """

    def __init__(self, points: Float[Tensor, "point 3"], mask: Bool[Tensor, " point"] | None = None) -> None:
        if mask is not None:
            # Infinitely far away is never found, and no shape depends on the mask.
            points = points.masked_fill(~mask[:, None], torch.inf)
        self._columns = points.t().contiguous()
        self._rows = max(1, _PAIRS_PER_CHUNK.get(points.device.type, 1 << 22) // max(1, len(points)))

    def knn(self, queries: Float[Tensor, "query 3"], k: int, max_radius: float | None) -> Neighbors:
        """Return the ``k`` nearest points, ties broken by index."""
        count = min(k, self._columns.shape[1])
        found = [_smallest(self._squared_distances(chunk), count) for chunk in queries.split(self._rows)]
        squared = torch.cat([values for values, _ in found]) if found else queries.new_zeros(0, count)
        index = torch.cat([index for _, index in found]) if found else queries.new_zeros(0, count, dtype=torch.int64)
        return padded(index, squared.sqrt_(), k, max_radius)

    def radius(
        self, queries: Float[Tensor, "query 3"], max_radius: float
    ) -> tuple[Int64[Tensor, " edge"], Int64[Tensor, " edge"]]:
        """Return all (point, query) pairs within ``max_radius``, sorted by query, then by point."""
        # Infinitely far (masked, or beyond the range of squares) is outside of every radius.
        max_radius = min(max_radius, torch.finfo(queries.dtype).max)
        pairs = []
        for first, chunk in enumerate(queries.split(self._rows)):
            close = (self._squared_distances(chunk).sqrt_() <= max_radius).nonzero()
            close[:, 0] += first * self._rows
            pairs.append(close)
        edges = torch.cat(pairs) if pairs else torch.zeros((0, 2), dtype=torch.int64, device=queries.device)
        return edges[:, 1].contiguous(), edges[:, 0].contiguous()

    def _squared_distances(self, queries: Float[Tensor, "query 3"]) -> Float[Tensor, "query point"]:
        total = (self._columns[0] - queries[:, 0:1]).square_()
        total += (self._columns[1] - queries[:, 1:2]).square_()
        total += (self._columns[2] - queries[:, 2:3]).square_()
        return total


def _smallest(
    squared: Float[Tensor, "query point"], count: int
) -> tuple[Float[Tensor, "query found"], Int64[Tensor, "query found"]]:
    """Return the ``count`` smallest values of each row in ascending order, ties by index; may overwrite its input."""
    if count <= _FEW:
        values, index = [], []
        for _ in range(count):
            lowest = squared.argmin(dim=1, keepdim=True)
            values.append(squared.gather(1, lowest))
            index.append(lowest)
            squared.scatter_(1, lowest, torch.inf)
        empty = squared.new_zeros(len(squared), 0)
        return torch.cat([empty, *values], dim=1), torch.cat([empty.long(), *index], dim=1)
    values, index = squared.topk(count, dim=1, largest=False)
    index, order = index.sort(dim=1)
    values, order = values.gather(1, order).sort(dim=1, stable=True)
    index = index.gather(1, order)
    # topk keeps an arbitrary one of several equal distances at rank `count`: sort those rows in full.
    tied = ((squared <= values[:, -1:]).sum(dim=1) > count).nonzero()[:, 0]
    if len(tied):
        index[tied] = squared[tied].sort(dim=1, stable=True).indices[:, :count]
    return values, index
