"""The paper's renderer: annular point features, two radiance fields, hierarchical sampling along rays."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vpd_lightning.finite import require_finite
from vpd_lightning.graph.neighbors import BACKENDS
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.renderer.features.feature_network import FeatureNetwork
from vpd_lightning.renderer.features.neighbor_features import NeighborFeatures
from vpd_lightning.renderer.features.point_features import check_kernels
from vpd_lightning.renderer.features.sample_features import SampleFeatures
from vpd_lightning.renderer.field.precision import at_least_float32
from vpd_lightning.renderer.field.radiance_field import RadianceField
from vpd_lightning.renderer.kernels.fused_features import FEATURE_BACKENDS
from vpd_lightning.renderer.rays.chunked_rays import (
    automatic_chunk_size,
    checkpointed,
    joined,
    ray_slices,
    uniform_draws,
)
from vpd_lightning.renderer.rays.hierarchical_sampling import (
    closed_color,
    coarse_samples,
    composited_rays,
    fine_samples,
    interval_ends,
    points_along,
)
from vpd_lightning.renderer.rays.volumetric import ray_weights
from vpd_lightning.types import Particles, Rays, RenderedRays


class PointNeRFRenderer(AbstractRenderer):
    """Renders rays as the paper's appendix (VPD implementation details, Renderer) and jaxnerf do.

    A coarse tier of ``num_coarse_samples`` stratified samples without view directions locates where light is absorbed;
    the fine tier evaluates the same samples and ``num_fine_samples`` more, drawn from the coarse weights, with
    view directions. The coarse samples' neighbours and features are used again by the fine tier.

    # Paper: exact instead of approximate nearest neighbours (the paper's search is not published).
    # Paper: the light that is left behind the last sample takes that sample's colour. jaxnerf gives the last sample an
    # interval of 1e10 instead; the two differ where its density is exactly 0, and 1e10 makes gradients of that size.

    Rays are rendered in chunks of about ``ray_chunk_size`` (``None``: by device, see ``automatic_chunk_size``), counted
    over the batch axis. With ``checkpoint_chunks``
    activations are computed again in the backward pass, with exact gradients: the neighbour tables, the random draws
    and the features of each sample (64 numbers) are kept, the networks' activations are not.

    ``kernel_normalization``, ``normalization_epsilon`` and ``feature_network`` make the features others than the
    paper's main model has them, see ``NeighborFeatures``. Error ``bounds`` exclude these.

    Exact, up to the order of summation: ``sort_particles`` (along a Morton curve, for the cache; equally distant
    particles may change places), ``reuse_coarse`` (the fine tier does not compute the coarse samples' neighbours and
    features again), ``features_backend`` (see ``fused_features``).

    Bounded, with the bounds in ``bounds``: ``max_radius`` (metres: farther particles are not seen). The bound holds for
    given places of the samples (``render_at``); that the coarse weights and with them the fine samples move too is
    measured, not bounded.
    """

    def __init__(
        self,
        *,
        feature_dim: int,
        num_neighbors: int,
        kernel_radii: Sequence[float],
        kernel_bandwidths: Sequence[float],
        near: float,
        far: float,
        num_coarse_samples: int,
        num_fine_samples: int,
        net_depth: int,
        net_width: int,
        skip_layer: int,
        net_width_condition: int,
        view_degree: int,
        density_activation: str,
        kernel_normalization: str | None,
        normalization_epsilon: float,
        feature_network: FeatureNetwork | None,
        neighbors_backend: str,
        features_backend: str,
        sort_particles: bool,
        reuse_coarse: bool,
        max_radius: float | None,
        ray_chunk_size: int | None,
        checkpoint_chunks: bool,
    ) -> None:
        super().__init__()
        check_kernels(kernel_radii, kernel_bandwidths)
        if not 0 <= near < far:
            raise ValueError(f"near and far must satisfy 0 <= near < far, got near={near} and far={far}.")
        if num_coarse_samples < 3:
            raise ValueError(f"num_coarse_samples must be at least 3, got {num_coarse_samples}.")
        counts = {"feature_dim": feature_dim, "num_neighbors": num_neighbors, "num_fine_samples": num_fine_samples}
        if ray_chunk_size is not None:
            counts["ray_chunk_size"] = ray_chunk_size
        for name, value in counts.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}.")
        if max_radius is not None and not max_radius >= 0:
            raise ValueError(f"max_radius must be at least 0, or null for off, got {max_radius}.")
        if neighbors_backend not in ("auto", *BACKENDS):
            raise ValueError(f"neighbors_backend must be auto or one of {BACKENDS}, got {neighbors_backend!r}.")
        if features_backend not in ("auto", *FEATURE_BACKENDS):
            raise ValueError(f"features_backend must be auto or one of {FEATURE_BACKENDS}, got {features_backend!r}.")
        self.variant = NeighborFeatures(
            feature_dim=feature_dim,
            kernel_radii=kernel_radii,
            kernel_bandwidths=kernel_bandwidths,
            kernel_normalization=kernel_normalization,
            normalization_epsilon=normalization_epsilon,
            feature_network=feature_network,
        )
        if not self.variant.is_plain and features_backend not in ("auto", "torch"):
            raise ValueError(
                f"features_backend must be auto or torch with kernel_normalization or feature_network: "
                f"{features_backend} supports the plain features only."
            )
        self.num_neighbors = num_neighbors
        self.kernel_radii = tuple(float(radius) for radius in kernel_radii)
        self.kernel_bandwidths = tuple(float(bandwidth) for bandwidth in kernel_bandwidths)
        self.near, self.far = float(near), float(far)
        self.num_coarse_samples = num_coarse_samples
        self.num_fine_samples = num_fine_samples
        self.neighbors_backend = neighbors_backend
        self.features_backend = features_backend
        self.sort_particles = sort_particles
        self.reuse_coarse = reuse_coarse
        self.max_radius = max_radius
        self.ray_chunk_size = ray_chunk_size
        self.checkpoint_chunks = checkpoint_chunks

        def field(degree: int | None) -> RadianceField:
            return RadianceField(
                input_dim=feature_dim * len(kernel_radii),
                net_depth=net_depth,
                net_width=net_width,
                skip_layer=skip_layer,
                net_width_condition=net_width_condition,
                view_degree=degree,
                density_activation=density_activation,
                # An optical depth of one over the whole ray: everything is seen, nothing is hidden.
                initial_density=1.0 / (far - near),
            )

        self.coarse = field(None)
        self.fine = field(view_degree)

    def forward(self, particles: Particles, rays: Rays, keys: RandomKeys | None) -> RenderedRays:
        """Render ``rays`` (``batch ray 3``); ``coarse_rgbs`` is there in training mode and wherever gradients are.

        Raises:
            NonFiniteError: when a particle or a ray is not finite.
            ValueError: when ``keys`` do not name one sample per member of the batch axis.
        """
        particles = particles.with_driven().without_padding()
        require_finite(
            "Rendering",
            positions=particles.positions,
            features=particles.features,
            rays=torch.cat([rays.origins, rays.directions]),
        )
        batch_size, num_rays = rays.origins.shape[:2]
        features = self._sample_features(particles)
        # All random numbers are drawn here, so that neither chunks nor recomputation change them.
        noise = quantiles = None
        if keys is not None:
            shape = (num_rays, self.num_coarse_samples)
            noise = uniform_draws(keys, "render/stratified", batch_size, shape, rays.origins)
            shape = (num_rays, self.num_fine_samples)
            quantiles = uniform_draws(keys, "render/importance", batch_size, shape, rays.origins)
        parts = [
            self._render(
                features,
                Rays(rays.origins[:, chunk], rays.directions[:, chunk]),
                None if noise is None else noise[:, chunk],
                None if quantiles is None else quantiles[:, chunk],
            )
            for chunk in ray_slices(
                num_rays, batch_size, self.ray_chunk_size or automatic_chunk_size(rays.origins.device)
            )
        ]
        return joined(parts)

    def render_at(self, particles: Particles, rays: Rays, t: Float[Tensor, "batch ray sample"]) -> RenderedRays:
        """Render with the fine tier alone at given ascending distances (metres); the error ``bounds`` refer to this."""
        features = self._sample_features(particles)
        origins, directions = at_least_float32(rays.origins), at_least_float32(rays.directions)
        return self._composited(*self._fine_tier(features, origins, directions, t), t)

    def point_features(
        self, particles: Particles, queries: Float[Tensor, "batch query 3"]
    ) -> Float[Tensor, "batch query feature"]:
        """Return what the radiance fields are given at points of the scene (metres)."""
        return self._sample_features(particles.with_driven().without_padding())(queries[:, :, None])[:, :, 0]

    def _render(
        self,
        features: SampleFeatures,
        rays: Rays,
        noise: Float[Tensor, "batch ray coarse"] | None,
        quantiles: Float[Tensor, "batch ray fine"] | None,
    ) -> RenderedRays:
        origins, directions = at_least_float32(rays.origins), at_least_float32(rays.directions)
        # Coarse: where is light stopped?
        t_coarse = coarse_samples(origins, self.near, self.far, self.num_coarse_samples, noise)
        coarse_features = features(points_along(origins, directions, t_coarse))
        needs_color = self.training or torch.is_grad_enabled()
        sigmas, rgbs = self._evaluate(self.coarse, coarse_features, directions=None, use_color=needs_color)
        coarse_weights, transmittance = ray_weights(sigmas, t_coarse, interval_ends(t_coarse, self.far))
        coarse_rgbs = None if rgbs is None else closed_color(coarse_weights, transmittance, rgbs)
        # Fine: the same samples, and more of them there.
        t_fine = fine_samples(t_coarse, coarse_weights.detach(), self.num_fine_samples, quantiles)
        t, order = torch.cat([t_coarse, t_fine], dim=-1).sort(dim=-1)
        if self.reuse_coarse:
            outputs = self._fine_tier(features, origins, directions, t, t_fine, order, coarse_features)
        else:
            outputs = self._fine_tier(features, origins, directions, t)
        return self._composited(*outputs, t, coarse_rgbs)

    def _fine_tier(
        self,
        features: SampleFeatures,
        origins: Float[Tensor, "batch ray 3"],
        directions: Float[Tensor, "batch ray 3"],
        t: Float[Tensor, "batch ray sample"],
        t_new: Float[Tensor, "batch ray new"] | None = None,
        order: Int64[Tensor, "batch ray sample"] | None = None,
        known: Float[Tensor, "batch ray known feature"] | None = None,
    ) -> tuple[Float[Tensor, "batch ray sample"], Float[Tensor, "batch ray sample 3"]]:
        """Return densities and colours at ``t``: of ``known`` features and new places, in the ``order`` of distance."""
        if known is None or t_new is None or order is None:
            return self._evaluate(self.fine, features(points_along(origins, directions, t)), directions)
        new = features(points_along(origins, directions, t_new))
        sigmas, rgbs = self._evaluate(self.fine, (known, new), directions)
        # The network does not care about order, so only its four outputs are sorted, not the features.
        return sigmas.gather(-1, order), rgbs.gather(-2, order[..., None].expand(*order.shape, 3))

    def _composited(
        self,
        sigmas: Float[Tensor, "batch ray sample"],
        rgbs: Float[Tensor, "batch ray sample 3"],
        t: Float[Tensor, "batch ray sample"],
        coarse_rgbs: Float[Tensor, "batch ray 3"] | None = None,
    ) -> RenderedRays:
        return composited_rays(sigmas, rgbs, t, self.far, coarse_rgbs)

    def _evaluate(
        self,
        field: RadianceField,
        features: Tensor | tuple[Tensor, ...],
        directions: Float[Tensor, "*batch 3"] | None,
        use_color: bool = True,
    ) -> tuple[Tensor, Any]:
        """Return a network's output at samples; several parts of ``features`` are joined along the samples."""
        parts = features if isinstance(features, tuple) else (features,)

        def network(*parts: Tensor) -> tuple[Tensor, Tensor | None]:
            return field(torch.cat(parts, dim=-2) if len(parts) > 1 else parts[0], directions, use_color)

        return checkpointed(network, *parts, is_enabled=self.checkpoint_chunks)

    def _sample_features(self, particles: Particles) -> SampleFeatures:
        return SampleFeatures(
            particles,
            num_neighbors=self.num_neighbors,
            kernel_radii=self.kernel_radii,
            kernel_bandwidths=self.kernel_bandwidths,
            max_radius=self.max_radius,
            neighbors_backend=self.neighbors_backend,
            features_backend=self.features_backend,
            is_sorted=self.sort_particles,
            is_checkpointed=self.checkpoint_chunks,
            variant=self.variant,
        )
