"""Nearest particles of sample locations, for a batch of particle sets."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.graph.neighbors import Neighbors, PointIndex
from vpd_lightning.renderer.precision import at_least_float32
from vpd_lightning.types import Particles


class ParticleSearch:
    """One search structure per member of the batch axis, over its valid particles only."""

    def __init__(self, particles: Particles, backend: str) -> None:
        self._members = []
        for positions, mask in zip(particles.positions.detach(), particles.mask, strict=True):
            valid = mask.nonzero()[:, 0]
            self._members.append((valid, PointIndex(at_least_float32(positions.index_select(0, valid)), backend)))

    @torch.no_grad()
    def knn(self, queries: Float[Tensor, "batch query 3"], k: int) -> Neighbors:
        """Return the ``k`` nearest valid particles of each query of the same batch member."""
        found = []
        for (valid, index), member_queries in zip(self._members, queries, strict=True):
            near = index.knn(member_queries, k)
            # Without any valid particle all indices are masked zeros and stay so.
            original = valid[near.index] if len(valid) else near.index
            found.append(Neighbors(original, near.distance, near.mask))
        return Neighbors(
            index=torch.stack([one.index for one in found]),
            distance=torch.stack([one.distance for one in found]),
            mask=torch.stack([one.mask for one in found]),
        )
