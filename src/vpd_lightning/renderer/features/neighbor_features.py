"""Variants of the annular features: a network on each neighbour's feature, and kernels normalised over neighbours."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vpd_lightning.graph.neighbors import Neighbors
from vpd_lightning.renderer.features.feature_network import FeatureNetwork
from vpd_lightning.renderer.features.point_features import kernel_weights, safe_norm
from vpd_lightning.renderer.field.precision import at_least_float32, full_precision
from vpd_lightning.types import Particles

NORMALIZATIONS = ("eps", "softmax")
_NEAREST = 1e-6  # metres; below this an inverse distance grows no further


class NeighborFeatures(nn.Module):
    """``f_k(x) = sum_i w_k(x, p_i) F(z_i, (x - p_i) / s)`` over the neighbours of ``x`` (positions in metres).

    Plain, as in the paper's section 3.3, ``w_k`` is the kernel ``exp(-((|x - p_i| - r_k) / b_k)^2)`` and ``F`` returns
    ``z_i``. Variants of the paper's appendix "Feature Encoding Experiments":

    ``feature_network`` is ``F``; ``s`` is the largest kernel radius. ``kernel_normalization`` divides each kernel by
    its sum over the neighbours: ``eps`` by that sum and ``normalization_epsilon`` more, so that far from all particles
    (about 3.7 bandwidths beyond the radius for 1e-6) features still fade away; ``softmax`` by the sum alone, in the
    space of logarithms, so that the nearest particle counts in full however far it is.

    # Paper: says "normalizes the feature contributions with respect to the relative distances", as PAPR (Zhang et al.
    # 2023) does; the formulas are ours. PAPR's own weights come from attention with a learned background score.
    """

    def __init__(
        self,
        *,
        feature_dim: int,
        kernel_radii: Sequence[float],
        kernel_bandwidths: Sequence[float],
        kernel_normalization: str | None,
        normalization_epsilon: float,
        feature_network: FeatureNetwork | None,
    ) -> None:
        super().__init__()
        if kernel_normalization not in (None, *NORMALIZATIONS):
            raise ValueError(
                f"kernel_normalization must be null or one of {NORMALIZATIONS}, got {kernel_normalization!r}."
            )
        if not normalization_epsilon > 0:
            raise ValueError(f"normalization_epsilon must be greater than 0, got {normalization_epsilon}.")
        if feature_network is not None:
            if feature_network.feature_dim != feature_dim:
                raise ValueError(
                    f"feature_network.feature_dim must be feature_dim={feature_dim}, got {feature_network.feature_dim}."
                )
            if not max(kernel_radii) > 0:
                raise ValueError(
                    "feature_network needs a kernel with a radius above 0, which is its unit of length; "
                    f"got kernel_radii={list(kernel_radii)}."
                )
        self.kernels = tuple(kernel_radii), tuple(kernel_bandwidths)
        self.kernel_normalization = kernel_normalization
        self.normalization_epsilon = float(normalization_epsilon)
        self.network = feature_network

    @property
    def is_plain(self) -> bool:
        """Whether these are the paper's own features, for which there are faster ways."""
        return self.kernel_normalization is None and self.network is None

    def forward(
        self,
        offsets: Float[Tensor, "row neighbor 3"],
        latents: Float[Tensor, "row neighbor feature"],
        mask: Bool[Tensor, "row neighbor"],
    ) -> Float[Tensor, "row kernel_feature"]:
        """Return the features of locations, kernel-major.

        Args:
            offsets: ``x - p_i`` in metres, of at least float32.
            latents: features ``z_i``; what ``mask`` leaves out must be finite.
            mask: which neighbours there are.
        """
        if self.network is not None:
            latents = self.network(latents, offsets / max(self.kernels[0])).to(offsets.dtype)
        with full_precision(offsets):
            summed = torch.bmm(self.weights(safe_norm(offsets), mask).transpose(1, 2), latents)
        return summed.flatten(1)

    def weights(
        self, distance: Float[Tensor, "row neighbor"], mask: Bool[Tensor, "row neighbor"]
    ) -> Float[Tensor, "row neighbor kernel"]:
        """Return what each neighbour counts under each kernel; 0 for neighbours that are not there."""
        share = None
        if self.network is not None and self.network.is_inverse_distance:
            inverse = mask / distance.clamp(min=_NEAREST)
            share = (inverse / inverse.sum(dim=-1, keepdim=True).clamp(min=torch.finfo(inverse.dtype).tiny))[..., None]
        if self.kernel_normalization == "softmax":
            return self._softmax(distance, mask, share)
        weights = kernel_weights(distance, mask, *self.kernels)
        if share is not None:
            weights = weights * share
        if self.kernel_normalization == "eps":
            weights = weights / (weights.sum(dim=-2, keepdim=True) + self.normalization_epsilon)
        return weights

    def _softmax(
        self,
        distance: Float[Tensor, "row neighbor"],
        mask: Bool[Tensor, "row neighbor"],
        share: Float[Tensor, "row neighbor 1"] | None,
    ) -> Float[Tensor, "row neighbor kernel"]:
        radii, bandwidths = (distance.new_tensor(values) for values in self.kernels)
        logits = -((distance[..., None] - radii) / bandwidths).square()
        if share is not None:
            logits = logits + share.clamp(min=torch.finfo(share.dtype).tiny).log()
        # Finite, not minus infinity: a row without any neighbour must not give NaN, here or in the backward pass.
        logits = logits.masked_fill(~mask[..., None], torch.finfo(logits.dtype).min)
        return torch.softmax(logits, dim=-2) * mask[..., None]


def gathered_neighbors(
    queries: Float[Tensor, "row 3"], particles: Particles, neighbors: Neighbors
) -> tuple[Float[Tensor, "row neighbor 3"], Float[Tensor, "row neighbor feature"], Bool[Tensor, "row neighbor"]]:
    """Return offsets ``x - p_i`` (metres), features and mask of the neighbours of locations, for ``NeighborFeatures``.

    ``particles`` have no batch axis; ``neighbors`` supplies index and mask only, so that gradients reach all three.
    """
    with full_precision(queries):
        positions = at_least_float32(particles.positions)
        table = torch.cat([positions, at_least_float32(particles.features).to(positions.dtype)], dim=-1)
        # What is not there is read from a row of zeros, lest NaN in row 0 gets through as 0 times NaN.
        table = torch.nn.functional.pad(table, (0, 0, 0, 1))
        index = torch.where(neighbors.mask, neighbors.index, len(table) - 1)
        gathered = table.index_select(0, index.flatten()).view(*index.shape, table.shape[1])
        offsets = at_least_float32(queries).to(positions.dtype)[:, None] - gathered[..., :3]
        return offsets, gathered[..., 3:], neighbors.mask
