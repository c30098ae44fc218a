"""The neighbour search that the rest of the package calls, whatever does the work behind it."""

from collections.abc import Callable
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.graph.neighbors.automatic import automatic_backend
from vpd_lightning.graph.neighbors.cluster import ClusterSearch
from vpd_lightning.graph.neighbors.contract import Neighbors, no_neighbors, require_finite
from vpd_lightning.graph.neighbors.numba_blocks import NumbaSearch
from vpd_lightning.graph.neighbors.reference import ReferenceSearch
from vpd_lightning.graph.neighbors.scipy_tree import ScipySearch
from vpd_lightning.graph.neighbors.triton_blocks import TritonSearch

BACKENDS = ("torch", "scipy", "torch_cluster", "numba", "triton")
"""What ``backend`` may be, beside ``auto``."""


class _Search(Protocol):
    def knn(self, queries: Tensor, k: int, max_radius: float | None) -> Neighbors: ...

    def radius(self, queries: Tensor, max_radius: float) -> tuple[Tensor, Tensor]: ...


_SEARCHES: dict[str, Callable[[Tensor], _Search]] = {
    "scipy": ScipySearch,
    "torch_cluster": ClusterSearch,
    "numba": NumbaSearch,
}

_MASKED_SEARCHES: dict[str, Callable[[Tensor, Tensor | None], _Search]] = {
    "torch": ReferenceSearch,
    "triton": TritonSearch,
}
"""These take a mask over the points and keep all shapes; the others are given the points inside it only."""


class PointIndex:
    """Points made ready for many searches: a tree is built once, not once per chunk of queries.

    Points outside ``mask`` are never found and may hold anything. In ``knn`` the backend ``triton`` never waits for
    the host and therefore cannot refuse numbers that are not finite; see ``TritonSearch.knn`` for what it does instead.

    Raises:
        ValueError: for an unknown backend.
        NonFiniteError: when a coordinate is not finite.
        ConfigError: when the backend's package is not installed, or its device is not there.
    """

    def __init__(
        self,
        points: Float[Tensor, "point 3"],
        backend: str = "auto",
        *,
        mask: Bool[Tensor, " point"] | None = None,
        is_radius: bool = False,
        is_graph: bool = False,
    ) -> None:
        if backend not in ("auto", *BACKENDS):
            raise ValueError(f"Unknown neighbour backend {backend!r}; allowed are auto, {', '.join(BACKENDS)}.")
        points = points.detach()
        if not points.is_floating_point():
            raise ValueError(f"points must be floating point, got {points.dtype}.")
        if backend == "auto":
            backend = automatic_backend(points.device, len(points), is_radius=is_radius, is_graph=is_graph)
        self.backend = backend
        self._dtype = points.dtype
        self._kept: Int64[Tensor, " kept"] | None = None
        if backend != "triton":
            require_finite("points", points if mask is None else points[mask])
        if mask is not None and backend not in _MASKED_SEARCHES:
            self._kept = mask.nonzero()[:, 0]
            points = points.index_select(0, self._kept)
        self._search: _Search | None = None
        if len(points):
            is_masked = backend in _MASKED_SEARCHES
            self._search = _MASKED_SEARCHES[backend](points, mask) if is_masked else _SEARCHES[backend](points)

    @torch.no_grad()
    def knn(self, queries: Float[Tensor, "query 3"], k: int, max_radius: float | None = None) -> Neighbors:
        """Return the ``k`` nearest points of each query, nearest first, no farther than ``max_radius`` metres."""
        if k < 0:
            raise ValueError(f"k must be at least 0, got {k}.")
        queries = self._checked(queries, max_radius)
        if self._search is None or k == 0 or len(queries) == 0:
            return no_neighbors(queries, k)
        found = self._search.knn(queries, k, max_radius)
        if self._kept is None:
            return found
        index = self._kept[found.index].masked_fill_(~found.mask, 0)
        return Neighbors(index, found.distance, found.mask)

    @torch.no_grad()
    def radius(
        self, queries: Float[Tensor, "query 3"], max_radius: float
    ) -> tuple[Int64[Tensor, " edge"], Int64[Tensor, " edge"]]:
        """Return all pairs within ``max_radius`` metres as (senders, receivers), sorted by receiver, then sender."""
        queries = self._checked(queries, max_radius)
        if self._search is None or len(queries) == 0:
            empty = torch.zeros(0, dtype=torch.int64, device=queries.device)
            return empty, empty
        senders, receivers = self._search.radius(queries, max_radius)
        return (senders if self._kept is None else self._kept[senders]), receivers

    def _checked(self, queries: Float[Tensor, "query 3"], max_radius: float | None) -> Float[Tensor, "query 3"]:
        if max_radius is not None and not max_radius >= 0:
            raise ValueError(f"max_radius must be at least 0, got {max_radius}.")
        queries = queries.detach().to(self._dtype)
        if self.backend != "triton":
            require_finite("queries", queries)
        return queries


def knn(
    points: Float[Tensor, "point 3"],
    queries: Float[Tensor, "query 3"],
    k: int,
    max_radius: float | None = None,
    backend: str = "auto",
) -> Neighbors:
    """Return the ``k`` nearest ``points`` of each query, nearest first, with ``distance <= max_radius`` (metres).

    The table has ``k`` columns however few points there are; ``mask`` tells which are real. Equal distances are
    ordered by index by the backends ``torch`` and ``numba``; others may order them differently. Float64 input is
    searched and measured in float64.

    Raises:
        ValueError: for a negative ``k`` or radius, or an unknown backend.
        NonFiniteError: when a coordinate is not finite.
    """
    return PointIndex(points, backend).knn(queries, k, max_radius)


def radius(
    points: Float[Tensor, "point 3"], queries: Float[Tensor, "query 3"], max_radius: float, backend: str = "auto"
) -> tuple[Int64[Tensor, " edge"], Int64[Tensor, " edge"]]:
    """Return every pair with ``distance <= max_radius`` (metres), without a cap, as ``(senders, receivers)``.

    Senders index ``points``, receivers index ``queries``; sorted by receiver, then by sender.

    Raises:
        ValueError: for a negative radius or an unknown backend.
        NonFiniteError: when a coordinate is not finite.
    """
    return PointIndex(points, backend, is_radius=True).radius(queries, max_radius)
