"""Features of a location: sums of the latent features of nearby particles under concentric annular kernels."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.graph.neighbors import Neighbors
from vpd_lightning.renderer.field.precision import at_least_float32, full_precision
from vpd_lightning.types import Particles


def annular_features(
    queries: Float[Tensor, "*batch query 3"],
    particles: Particles,
    neighbors: Neighbors,
    kernel_radii: Float[Tensor, " kernel"] | Sequence[float],
    kernel_bandwidths: Float[Tensor, " kernel"] | Sequence[float],
) -> Float[Tensor, "*batch query kernel_feature"]:
    """Return ``f(x)``, the concatenation over kernels of ``sum_i k(x, p_i) z_i`` (paper section 3.3).

    ``k(x, p) = exp(-((|p - x| - r) / b)^2)`` with radii ``r`` and bandwidths ``b`` in metres. The result is
    kernel-major: all features under the first kernel, then under the second. ``neighbors`` supplies index and mask
    only; distances are computed again so that gradients reach particles, features and queries. The gradient of a
    distance is defined as zero where the distance is zero. Computed in at least float32, outside autocast. This is the
    definition of ``fused_features``, which is faster and keeps less.

    The rows of ``[query, neighbor, feature * kernel]`` are never written down: positions and features are gathered
    once, together, and one small matrix product per query sums over its neighbours.
    """
    with full_precision(queries):
        positions = at_least_float32(particles.positions)
        features = at_least_float32(particles.features).to(positions.dtype)
        queries = at_least_float32(queries).to(positions.dtype)
        num_queries, k = neighbors.index.shape[-2:]
        num_particles, feature_dim = features.shape[-2:]
        num_sets, width = math.prod(queries.shape[:-2]), len(kernel_radii) * feature_dim
        table = torch.cat([positions, features], dim=-1).reshape(-1, 3 + feature_dim)
        table = torch.nn.functional.pad(table, (0, 0, 0, 1))
        index = neighbors.index.reshape(num_sets, num_queries, k)
        if len(index) > 1:
            index = index + num_particles * torch.arange(len(index), device=index.device)[:, None, None]
        # What is not there is read from the row of zeros, lest NaN in row 0 gets through as 0 times NaN.
        index = torch.where(neighbors.mask.reshape(index.shape), index, len(table) - 1)
        gathered = table.index_select(0, index.reshape(-1)).view(num_sets * num_queries, k, 3 + feature_dim)
        distance = safe_norm(gathered[..., :3] - queries.reshape(-1, 1, 3))
        mask = neighbors.mask.reshape(num_sets * num_queries, k)
        weights = kernel_weights(distance, mask, kernel_radii, kernel_bandwidths)
        summed = torch.bmm(weights.transpose(1, 2), gathered[..., 3:])
        return summed.reshape(*queries.shape[:-1], width)


def kernel_weights(
    distance: Float[Tensor, "*shape"],
    mask: Bool[Tensor, "*shape"],
    kernel_radii: Float[Tensor, " kernel"] | Sequence[float],
    kernel_bandwidths: Float[Tensor, " kernel"] | Sequence[float],
) -> Float[Tensor, "*shape kernel"]:
    """Return ``exp(-((distance - radius) / bandwidth)^2)`` of each kernel, and 0 where ``mask`` is false."""
    radii = torch.as_tensor(kernel_radii, dtype=distance.dtype, device=distance.device)
    bandwidths = torch.as_tensor(kernel_bandwidths, dtype=distance.dtype, device=distance.device)
    scaled = (distance[..., None] - radii) / bandwidths
    return torch.exp(-scaled.square()) * mask[..., None]


def safe_norm(vector: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape"]:
    """Return the length of a vector with gradient zero, not NaN, where the length is zero."""
    squared = vector.square().sum(dim=-1)
    is_positive = squared > 0
    return torch.where(is_positive, torch.where(is_positive, squared, 1.0).sqrt(), 0.0)


def check_kernels(kernel_radii: Sequence[float], kernel_bandwidths: Sequence[float]) -> None:
    """Refuse kernels that do not come in pairs, a negative radius, a bandwidth that is not positive, or infinite ones.

    Raises:
        ValueError: naming what was given and what is allowed.
    """
    if len(kernel_radii) != len(kernel_bandwidths) or not len(kernel_radii):
        raise ValueError(
            f"kernel_radii and kernel_bandwidths must be as long as each other and not empty, "
            f"got {len(kernel_radii)} and {len(kernel_bandwidths)}."
        )
    if not all(0 <= radius < math.inf for radius in kernel_radii):
        raise ValueError(f"kernel_radii must be finite and at least 0, got {list(kernel_radii)}.")
    if not all(0 < bandwidth < math.inf for bandwidth in kernel_bandwidths):
        raise ValueError(f"kernel_bandwidths must be finite and greater than 0, got {list(kernel_bandwidths)}.")
