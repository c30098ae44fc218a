"""Annular features of sample locations, for a batch of particle sets: search, then sum over the neighbours."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from vpd_lightning.graph.neighbors import Neighbors
from vpd_lightning.renderer.features.neighbor_features import NeighborFeatures, gathered_neighbors
from vpd_lightning.renderer.kernels.fused_features import fused_annular_features
from vpd_lightning.renderer.rays.chunked_rays import checkpointed
from vpd_lightning.renderer.rays.particle_search import ParticleSearch, morton_sorted
from vpd_lightning.types import Particles


class SampleFeatures:
    """The particles of a batch, prepared once and then queried at many locations.

    ``max_radius`` (metres, ``None``: no limit) leaves out what is farther, see ``bounds.feature_error_bound``.
    ``is_checkpointed`` keeps, of all that lies between particles and features, only the neighbours' indices for the
    backward pass. A fused backend does that by itself; to sum once more costs it next to nothing, and ``auto`` may have
    to fall back to one that keeps everything. ``variant`` may make the features others than the paper's, which no fused
    backend computes; ``None`` is the paper's.
    """

    def __init__(
        self,
        particles: Particles,
        *,
        num_neighbors: int,
        kernel_radii: Sequence[float],
        kernel_bandwidths: Sequence[float],
        max_radius: float | None,
        neighbors_backend: str,
        features_backend: str,
        is_sorted: bool,
        is_checkpointed: bool,
        variant: NeighborFeatures | None,
    ) -> None:
        # Padding may hold anything, and index 0 stands for "no neighbour" too: what it holds must at least be finite.
        mask = particles.mask[..., None]
        positions = torch.where(mask, particles.positions, 0.0)
        particles = Particles(positions, torch.where(mask, particles.features, 0.0), particles.mask)
        if is_sorted:
            particles = morton_sorted(particles)
        self._search = ParticleSearch(particles, neighbors_backend)
        # All members in one table, which is what the indices of the search count through.
        self._particles = Particles(
            particles.positions.flatten(0, 1), particles.features.flatten(0, 1), particles.mask.flatten()
        )
        self._num_neighbors, self._max_radius = num_neighbors, max_radius
        self._kernels = (kernel_radii, kernel_bandwidths)
        self._features_backend = features_backend
        self._is_checkpointed = is_checkpointed
        self._variant = variant

    def __call__(self, points: Float[Tensor, "batch ray sample 3"]) -> Float[Tensor, "batch ray sample feature"]:
        """Return the features of every sample of every ray."""
        batch_size, num_rays, num_samples = points.shape[:3]
        rows = self.of_rows(points.flatten(0, 2), [num_rays * num_samples] * batch_size)
        return rows.unflatten(0, points.shape[:3])

    def of_rows(self, points: Float[Tensor, "row 3"], counts: Sequence[int]) -> Float[Tensor, "row feature"]:
        """Return the features of locations: the first ``counts[0]`` lie in the first member's scene, and so on."""
        found = self._search.knn(points, counts, self._num_neighbors, self._max_radius)
        if not (self._is_checkpointed and torch.is_grad_enabled()):
            return self._summed(points, self._particles, found)
        # Half of the bytes, and nothing else of the neighbours lives until the backward pass; -1 for none.
        packed = found.index.masked_fill(~found.mask, -1).int()

        def again(positions: Tensor, latents: Tensor) -> Tensor:
            particles = Particles(positions, latents, self._particles.mask)
            return self._summed(points, particles, _unpacked(packed))

        return checkpointed(again, self._particles.positions, self._particles.features, is_enabled=True)

    def _summed(
        self, points: Float[Tensor, "row 3"], particles: Particles, neighbors: Neighbors
    ) -> Float[Tensor, "row feature"]:
        if self._variant is not None and not self._variant.is_plain:
            return self._variant(*gathered_neighbors(points, particles, neighbors))
        return fused_annular_features(points, particles, neighbors, *self._kernels, self._features_backend)


def _unpacked(packed: Int32[Tensor, "row neighbor"]) -> Neighbors:
    distance = torch.zeros(1, device=packed.device).expand(packed.shape)  # which the features measure themselves
    return Neighbors(packed.clamp(min=0).long(), distance, packed >= 0)
