"""The neighbour search that the rest of the package calls, whatever does the work behind it."""

import importlib.util
from collections.abc import Callable
from typing import Protocol

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vpd_lightning.graph.neighbors.cluster import ClusterSearch
from vpd_lightning.graph.neighbors.contract import Neighbors, no_neighbors, require_finite
from vpd_lightning.graph.neighbors.reference import ReferenceSearch
from vpd_lightning.graph.neighbors.scipy_tree import ScipySearch

BACKENDS = ("torch", "scipy", "torch_cluster")
"""What ``backend`` may be, beside ``auto``."""

_TREE_FROM_POINTS = 64
"""On a CPU a tree wins from about this many points on (measured in float32, k = 2 and k = 16)."""

_TREE_FROM_RADIUS_POINTS = 32768
"""A tree's radius search makes Python lists, so brute force stays ahead for longer."""


class _Search(Protocol):
    def knn(self, queries: Tensor, k: int, max_radius: float | None) -> Neighbors: ...

    def radius(self, queries: Tensor, max_radius: float) -> tuple[Tensor, Tensor]: ...


def automatic_backend(device: torch.device, num_points: int, *, is_radius: bool = False, is_graph: bool = False) -> str:
    """Return the backend that ``auto`` means: a fixed rule, never a timing, so that a run repeats bit for bit.

    ``is_graph`` marks the searches of the dynamics' graph, which take torch-cluster where it is installed.
    """
    if is_graph and importlib.util.find_spec("torch_cluster") is not None:
        return "torch_cluster"
    if device.type == "cpu":
        return "scipy" if num_points >= (_TREE_FROM_RADIUS_POINTS if is_radius else _TREE_FROM_POINTS) else "torch"
    return "torch"


_SEARCHES: dict[str, Callable[[Tensor], _Search]] = {
    "torch": ReferenceSearch,
    "scipy": ScipySearch,
    "torch_cluster": ClusterSearch,
}


class PointIndex:
    """Points made ready for many searches: a tree is built once, not once per chunk of queries.

    Raises:
        ValueError: for an unknown backend.
        NonFiniteError: when a coordinate is not finite.
        ConfigError: when the backend's package is not installed.
    """

    def __init__(
        self,
        points: Float[Tensor, "point 3"],
        backend: str = "auto",
        *,
        is_radius: bool = False,
        is_graph: bool = False,
    ) -> None:
        if backend not in ("auto", *BACKENDS):
            raise ValueError(f"Unknown neighbour backend {backend!r}; allowed are auto, {', '.join(BACKENDS)}.")
        points = points.detach()
        if not points.is_floating_point():
            raise ValueError(f"points must be floating point, got {points.dtype}.")
        require_finite("points", points)
        if backend == "auto":
            backend = automatic_backend(points.device, len(points), is_radius=is_radius, is_graph=is_graph)
        self.backend = backend
        self._points = points
        self._search: _Search | None = None
        if len(points):
            self._search = _SEARCHES[backend](points)

    @torch.no_grad()
    def knn(self, queries: Float[Tensor, "query 3"], k: int, max_radius: float | None = None) -> Neighbors:
        """Return the ``k`` nearest points of each query, nearest first, no farther than ``max_radius`` metres."""
        if k < 0:
            raise ValueError(f"k must be at least 0, got {k}.")
        queries = self._checked(queries, max_radius)
        if self._search is None or k == 0 or len(queries) == 0:
            return no_neighbors(queries, k)
        return self._search.knn(queries, k, max_radius)

    @torch.no_grad()
    def radius(
        self, queries: Float[Tensor, "query 3"], max_radius: float
    ) -> tuple[Int64[Tensor, " edge"], Int64[Tensor, " edge"]]:
        """Return all pairs within ``max_radius`` metres as (senders, receivers), sorted by receiver, then sender."""
        queries = self._checked(queries, max_radius)
        if self._search is None or len(queries) == 0:
            empty = torch.zeros(0, dtype=torch.int64, device=queries.device)
            return empty, empty
        return self._search.radius(queries, max_radius)

    def _checked(self, queries: Float[Tensor, "query 3"], max_radius: float | None) -> Float[Tensor, "query 3"]:
        if max_radius is not None and not max_radius >= 0:
            raise ValueError(f"max_radius must be at least 0, got {max_radius}.")
        queries = queries.detach().to(self._points.dtype)
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
    ordered by index by the ``torch`` backend; others may order them differently. Float64 input is searched and
    measured in float64.

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
