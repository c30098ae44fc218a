"""Search with torch-cluster (an extra): exact, on CPU and CUDA, called directly and not through torch-geometric.

Its CUDA kernels compare every pair and allow at most 100 neighbours; its ``radius`` excludes the bound and keeps the
first ``max_num_neighbors`` it meets, so it is given room for all of them and the exact bound is applied afterwards.
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vpd_lightning.errors import ConfigError
from vpd_lightning.graph.neighbors.contract import Neighbors, measured, squared_norm

_SLACK = 1.0 + 1e-5


class ClusterSearch:
    """Hands the points to torch-cluster, which is imported when the first search is built.

    Raises:
        ConfigError: when torch-cluster is not installed.
    """

    def __init__(self, points: Float[Tensor, "point 3"]) -> None:
        try:
            import torch_cluster
        except ImportError as error:
            raise ConfigError(
                "neighbors_backend=torch_cluster needs the package torch-cluster, which is not installed.\n"
                "Install it with `make cluster` (it is compiled), or use neighbors_backend=auto."
            ) from error
        self._library = torch_cluster
        self._points = points.contiguous()

    def knn(self, queries: Float[Tensor, "query 3"], k: int, max_radius: float | None) -> Neighbors:
        """Return the ``k`` nearest points."""
        count = min(k, len(self._points))
        receivers, senders = self._library.knn(self._points, queries.contiguous(), count)
        # The pairs come grouped by query, but a query may have fewer than `count` of them.
        receivers, order = receivers.sort(stable=True)
        starts = torch.searchsorted(receivers, torch.arange(len(queries), device=receivers.device))
        rank = torch.arange(len(receivers), device=receivers.device) - starts[receivers]
        index = torch.full((len(queries), count), -1, dtype=torch.int64, device=receivers.device)
        index[receivers, rank] = senders[order]
        return measured(self._points, queries, index, k, max_radius)

    def radius(
        self, queries: Float[Tensor, "query 3"], max_radius: float
    ) -> tuple[Int64[Tensor, " edge"], Int64[Tensor, " edge"]]:
        """Return all (point, query) pairs within ``max_radius``, sorted by query, then by point."""
        bound = max_radius * _SLACK + 1e-12
        receivers, senders = self._library.radius(
            self._points, queries.contiguous(), bound, max_num_neighbors=len(self._points)
        )
        offset = self._points.index_select(0, senders) - queries.index_select(0, receivers)
        within = squared_norm(offset).sqrt_() <= max_radius
        senders, receivers = senders[within], receivers[within]
        order = (receivers * len(self._points) + senders).argsort()
        return senders[order], receivers[order]
