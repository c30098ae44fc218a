"""Exact search with SciPy's k-d tree on the CPU: the fast choice there for many points and queries."""

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.spatial import cKDTree
from torch import Tensor

from vpd_lightning.graph.neighbors.contract import Neighbors, measured, squared_norm

_SLACK = 1.0 + 1e-5
"""The tree searches a little farther than asked (it excludes its bound); the exact radius is applied afterwards."""


def _array(positions: Float[Tensor, "any 3"]) -> np.ndarray:
    return positions.detach().to("cpu", torch.float64).numpy()


class ScipySearch:
    """Holds one tree over the points; the tree works in float64."""

    def __init__(self, points: Float[Tensor, "point 3"]) -> None:
        self._points = points
        self._tree = cKDTree(_array(points))

    def knn(self, queries: Float[Tensor, "query 3"], k: int, max_radius: float | None) -> Neighbors:
        """Return the ``k`` nearest points; the tree chooses among equal distances."""
        num_points = len(self._points)
        count = min(k, num_points)
        bound = np.inf if max_radius is None else _bound(max_radius)
        _, index = self._tree.query(
            _array(queries), k=count, distance_upper_bound=bound, workers=torch.get_num_threads()
        )
        index = index.reshape(len(queries), count)
        index[index == num_points] = -1
        found = torch.from_numpy(index).to(queries.device, torch.int64)
        return measured(self._points, queries, found, k, max_radius)

    def radius(
        self, queries: Float[Tensor, "query 3"], max_radius: float
    ) -> tuple[Int64[Tensor, " edge"], Int64[Tensor, " edge"]]:
        """Return all (point, query) pairs within ``max_radius``, sorted by query, then by point."""
        lists = self._tree.query_ball_point(
            _array(queries), r=_bound(max_radius), workers=torch.get_num_threads(), return_sorted=True
        )
        lengths = np.fromiter((len(one) for one in lists), dtype=np.int64, count=len(lists))
        flat = np.fromiter((sender for one in lists for sender in one), dtype=np.int64, count=int(lengths.sum()))
        senders = torch.from_numpy(flat).to(queries.device)
        receivers = torch.from_numpy(np.repeat(np.arange(len(lists)), lengths)).to(queries.device)
        offset = self._points.index_select(0, senders) - queries.index_select(0, receivers)
        within = squared_norm(offset).sqrt_() <= max_radius
        return senders[within], receivers[within]


def _bound(max_radius: float) -> float:
    return max_radius * _SLACK + 1e-12
