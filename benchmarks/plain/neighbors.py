"""Nearest neighbours the plain way: torch-cluster where it is installed, else brute force in chunks."""

import torch
from torch import Tensor

try:
    import torch_cluster
except ImportError:
    torch_cluster = None

PAIRS_PER_CHUNK = {"cpu": 1 << 23, "cuda": 1 << 28}
SEARCH = "brute force" if torch_cluster is None else "torch-cluster"


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
    found = []
    for part in queries.split(max(1, PAIRS_PER_CHUNK[points.device.type] // max(1, len(points)))):
        square = (part[:, None] - points[None]).square().sum(dim=-1)
        found.append(square.topk(k, dim=1, largest=False))
    index = torch.cat([one.indices for one in found])
    return index, torch.cat([one.values for one in found]).sqrt()


@torch.no_grad()
def pairs_within(points: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Return all pairs (sender, receiver) of different points no farther apart than ``radius``."""
    distance = (points[:, None] - points[None]).square().sum(dim=-1).sqrt()
    receivers, senders = (distance <= radius).fill_diagonal_(False).nonzero(as_tuple=True)
    return senders, receivers
