"""Nearest particles of sample locations, for a batch of particle sets."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.graph.neighbors import Neighbors, PointIndex
from vpd_lightning.graph.ordering import morton_order
from vpd_lightning.renderer.field.precision import at_least_float32
from vpd_lightning.types import Particles


class ParticleSearch:
    """One search structure per member of the batch axis, over its valid particles only.

    Locations come as rows, those of the first member first. The neighbours' indices count through the particles of
    all members, as in ``particles.positions.flatten(0, 1)``.
    """

    def __init__(self, particles: Particles, backend: str) -> None:
        self._num_particles = particles.num_particles
        self._members = [
            PointIndex(at_least_float32(positions), backend, mask=mask)
            for positions, mask in zip(particles.positions.detach(), particles.mask, strict=True)
        ]

    @torch.no_grad()
    def knn(
        self, queries: Float[Tensor, "row 3"], counts: Sequence[int], k: int, max_radius: float | None
    ) -> Neighbors:
        """Return the ``k`` nearest valid particles, no farther than ``max_radius``; ``counts`` rows per member."""
        found = [
            index.knn(some, k, max_radius)
            for index, some in zip(self._members, queries.split(list(counts)), strict=True)
        ]
        if len(found) == 1:
            return found[0]
        return Neighbors(
            index=torch.cat([one.index + member * self._num_particles for member, one in enumerate(found)]),
            distance=torch.cat([one.distance for one in found]),
            mask=torch.cat([one.mask for one in found]),
        )


def morton_sorted(particles: Particles) -> Particles:
    """Put what lies close together next to each other, member by member, so that gathers stay in the cache.

    Nothing that is rendered depends on the order of particles, except which of several equally distant ones is taken.
    """
    with torch.no_grad():
        order = torch.stack([morton_order(member) for member in at_least_float32(particles.positions)])

    def taken(values: Tensor) -> Tensor:
        return values.gather(1, order[..., None].expand(*order.shape, values.shape[-1]))

    return Particles(taken(particles.positions), taken(particles.features), particles.mask.gather(1, order))
