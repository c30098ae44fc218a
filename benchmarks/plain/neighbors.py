"""Nearest neighbours as one writes them: torch-cluster where it is installed, else ``torch.cdist`` and ``topk``."""

import torch
from torch import Tensor

try:
    import torch_cluster
except ImportError:
    torch_cluster = None

PAIRS_PER_CHUNK = 1 << 24
SEARCH = "cdist and topk" if torch_cluster is None else "torch-cluster"


@torch.no_grad()
def nearest(points: Tensor, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Return indices and distances of the ``k`` nearest points of each query, nearest first, each (query, k).

    Fewer points than ``k``: as many columns as there are points.
    """
    k = min(k, len(points))
    # torch-cluster's CUDA kernel is brute force too, and answers in float32.
    if torch_cluster is not None and points.dtype == torch.float32:
        index = torch_cluster.knn(points, queries, k)[1].view(len(queries), k)
        return index, (points[index] - queries[:, None]).square().sum(dim=-1).sqrt()
    parts = queries.split(max(1, PAIRS_PER_CHUNK // max(1, len(points))))
    found = [_distances(part, points).topk(k, dim=1, largest=False) for part in parts]
    return torch.cat([one.indices for one in found]), torch.cat([one.values for one in found])


@torch.no_grad()
def pairs_within(points: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Return all pairs (sender, receiver) of different points no farther apart than ``radius``."""
    receivers, senders = (_distances(points, points) <= radius).fill_diagonal_(False).nonzero(as_tuple=True)
    return senders, receivers


def _distances(one: Tensor, other: Tensor) -> Tensor:
    """All distances from differences. The default's matrix product loses the digits, for a sixth of the time."""
    return torch.cdist(one, other, compute_mode="donot_use_mm_for_euclid_dist")  # noqa: TID251
