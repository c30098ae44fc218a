"""The paper's renderer: annular point features, two radiance fields, hierarchical sampling along rays."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.geometry.ray_sampling import even_quantiles, sample_pdf, stratified_samples
from vpd_lightning.graph.neighbors import BACKENDS, Neighbors
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.renderer.chunked_rays import joined, ray_slices, recomputed, uniform_draws
from vpd_lightning.renderer.particle_search import ParticleSearch
from vpd_lightning.renderer.point_features import annular_features, check_kernels
from vpd_lightning.renderer.precision import at_least_float32, full_precision
from vpd_lightning.renderer.radiance_field import RadianceField
from vpd_lightning.renderer.volumetric import ray_weights
from vpd_lightning.types import Particles, Rays, RenderedRays


class PointNeRFRenderer(AbstractRenderer):
    """Renders rays as the paper's appendix (VPD implementation details, Renderer) and jaxnerf do.

    A coarse tier of ``num_coarse_samples`` stratified samples without view directions says where light is stopped;
    the fine tier looks at the same samples and ``num_fine_samples`` more, drawn where the coarse weights are, with
    view directions. The coarse samples' neighbours and features are used again by the fine tier.

    # Paper: exact instead of approximate nearest neighbours (the paper's search is not published).
    # Paper: the light that is left behind the last sample takes that sample's colour. jaxnerf gives the last sample an
    # interval of 1e10 instead; the two differ where its density is exactly 0, and 1e10 makes gradients of that size.

    Rays are rendered in chunks of about ``ray_chunk_size``, counted over the batch axis. With ``checkpoint_chunks``
    activations are computed again in the backward pass, with exact gradients: the neighbour tables, the random draws
    and the features of each sample (64 numbers) are kept, the networks' activations are not.
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
        neighbors_backend: str,
        ray_chunk_size: int,
        checkpoint_chunks: bool,
    ) -> None:
        super().__init__()
        check_kernels(kernel_radii, kernel_bandwidths)
        if not 0 <= near < far:
            raise ValueError(f"near and far must satisfy 0 <= near < far, got near={near} and far={far}.")
        if num_coarse_samples < 3:
            raise ValueError(f"num_coarse_samples must be at least 3, got {num_coarse_samples}.")
        counts = {"feature_dim": feature_dim, "num_neighbors": num_neighbors, "num_fine_samples": num_fine_samples}
        for name, value in (counts | {"ray_chunk_size": ray_chunk_size}).items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}.")
        if neighbors_backend not in ("auto", *BACKENDS):
            raise ValueError(f"neighbors_backend must be auto or one of {BACKENDS}, got {neighbors_backend!r}.")
        self.num_neighbors = num_neighbors
        self.kernel_radii = tuple(float(radius) for radius in kernel_radii)
        self.kernel_bandwidths = tuple(float(bandwidth) for bandwidth in kernel_bandwidths)
        self.near, self.far = float(near), float(far)
        self.num_coarse_samples = num_coarse_samples
        self.num_fine_samples = num_fine_samples
        self.neighbors_backend = neighbors_backend
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
        batch_size, num_rays = rays.origins.shape[:2]
        search = ParticleSearch(particles, self.neighbors_backend)
        # All random numbers are drawn here, so that neither chunks nor recomputation change them.
        noise = quantiles = None
        if keys is not None:
            shape = (num_rays, self.num_coarse_samples)
            noise = uniform_draws(keys, "render/stratified", batch_size, shape, rays.origins)
            shape = (num_rays, self.num_fine_samples)
            quantiles = uniform_draws(keys, "render/importance", batch_size, shape, rays.origins)
        parts = []
        for chunk in ray_slices(num_rays, batch_size, self.ray_chunk_size):
            some = Rays(rays.origins[:, chunk], rays.directions[:, chunk])
            parts.append(
                self._render(
                    particles,
                    search,
                    some,
                    None if noise is None else noise[:, chunk],
                    None if quantiles is None else quantiles[:, chunk],
                )
            )
        return joined(parts)

    def _render(
        self,
        particles: Particles,
        search: ParticleSearch,
        rays: Rays,
        noise: Float[Tensor, "batch ray coarse"] | None,
        quantiles: Float[Tensor, "batch ray fine"] | None,
    ) -> RenderedRays:
        origins, directions = at_least_float32(rays.origins), at_least_float32(rays.directions)
        t_coarse = self._coarse_samples(origins, noise)
        coarse_features = self._features(particles, search, origins, directions, t_coarse)
        needs_color = self.training or torch.is_grad_enabled()
        sigmas, rgbs = recomputed(
            lambda features: self.coarse(features, None, use_color=needs_color),
            coarse_features,
            is_enabled=self.checkpoint_chunks,
        )
        coarse_weights, transmittance = ray_weights(sigmas, t_coarse, self._ends(t_coarse))
        coarse_rgbs = None if rgbs is None else _closed(coarse_weights, transmittance, rgbs)

        t_fine = self._fine_samples(t_coarse, coarse_weights.detach(), quantiles)
        fine_features = self._features(particles, search, origins, directions, t_fine)
        sigmas, rgbs = recomputed(
            lambda first, second: self.fine(torch.cat([first, second], dim=-2), directions),
            coarse_features,
            fine_features,
            is_enabled=self.checkpoint_chunks,
        )
        # The network does not care about order, so only its four outputs are sorted, not the features.
        t, order = torch.cat([t_coarse, t_fine], dim=-1).sort(dim=-1)
        sigmas = sigmas.gather(-1, order)
        rgbs = rgbs.gather(-2, order[..., None].expand(*order.shape, 3))
        weights, transmittance = ray_weights(sigmas, t, self._ends(t))
        with full_precision(t):
            depths = (weights * t).sum(dim=-1) + transmittance * t[..., -1]
        return RenderedRays(_closed(weights, transmittance, rgbs), depths, 1.0 - transmittance, coarse_rgbs)

    def _coarse_samples(
        self, origins: Float[Tensor, "batch ray 3"], noise: Float[Tensor, "batch ray coarse"] | None
    ) -> Float[Tensor, "batch ray coarse"]:
        batch_size, num_rays = origins.shape[:2]
        flat = None if noise is None else noise.flatten(0, 1)
        t = stratified_samples(self.near, self.far, self.num_coarse_samples, batch_size * num_rays, flat)
        return t.to(origins).view(batch_size, num_rays, self.num_coarse_samples)

    def _fine_samples(
        self,
        t_coarse: Float[Tensor, "batch ray coarse"],
        weights: Float[Tensor, "batch ray coarse"],
        quantiles: Float[Tensor, "batch ray fine"] | None,
    ) -> Float[Tensor, "batch ray fine"]:
        # As jaxnerf: bins between the midpoints of coarse samples, so the first and last weight have none.
        middles = ((t_coarse[..., 1:] + t_coarse[..., :-1]) / 2).flatten(0, 1)
        if quantiles is None:
            u = even_quantiles(self.num_fine_samples, len(middles), middles.device)
        else:
            u = quantiles.flatten(0, 1)
        t_fine = sample_pdf(middles, weights[..., 1:-1].flatten(0, 1), u)
        return t_fine.view(*t_coarse.shape[:-1], self.num_fine_samples)

    def _features(
        self,
        particles: Particles,
        search: ParticleSearch,
        origins: Float[Tensor, "batch ray 3"],
        directions: Float[Tensor, "batch ray 3"],
        t: Float[Tensor, "batch ray sample"],
    ) -> Float[Tensor, "batch ray sample feature"]:
        with full_precision(t):
            points = origins[..., None, :] + t[..., None] * directions[..., None, :]
        queries = points.flatten(1, 2)
        found = search.knn(queries, self.num_neighbors)
        # The distances of the search are not needed any more; only the indices live until the backward pass.
        neighbors = Neighbors(found.index, found.distance.new_zeros(1).expand(found.index.shape), found.mask)
        features = recomputed(
            lambda positions, latents: annular_features(
                queries,
                Particles(positions, latents, particles.mask),
                neighbors,
                self.kernel_radii,
                self.kernel_bandwidths,
            ),
            particles.positions,
            particles.features,
            is_enabled=self.checkpoint_chunks,
        )
        return features.unflatten(1, t.shape[1:])

    def _ends(self, t: Float[Tensor, "batch ray sample"]) -> Float[Tensor, "batch ray sample"]:
        """Each sample stands for the way to the next one, the last for the way to the far plane."""
        return torch.cat([t[..., 1:], torch.full_like(t[..., :1], self.far)], dim=-1)


def _closed(
    weights: Float[Tensor, "batch ray sample"],
    transmittance: Float[Tensor, "batch ray"],
    rgbs: Float[Tensor, "batch ray sample 3"],
) -> Float[Tensor, "batch ray 3"]:
    """Return the colour of each ray, with the left-over light going to the last sample's colour."""
    with full_precision(weights):
        return (weights[..., None] * rgbs).sum(dim=-2) + transmittance[..., None] * rgbs[..., -1, :]
