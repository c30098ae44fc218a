"""A renderer that looks only where particles are: samples around a depth hint per ray, and an explicit background."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.finite import require_finite
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.renderer.features.feature_network import FeatureNetwork
from vpd_lightning.renderer.features.neighbor_features import NeighborFeatures
from vpd_lightning.renderer.features.point_features import check_kernels
from vpd_lightning.renderer.features.sample_features import SampleFeatures
from vpd_lightning.renderer.field.positional_encoding import encoding_dim, positional_encoding
from vpd_lightning.renderer.field.precision import at_least_float32, full_precision
from vpd_lightning.renderer.field.radiance_field import RadianceField
from vpd_lightning.renderer.kernels.ray_search import Candidates, check_backend
from vpd_lightning.renderer.rays.chunked_rays import checkpointed, joined, ray_slices, uniform_draws
from vpd_lightning.renderer.rays.ray_candidates import (
    CandidateTable,
    RayCandidates,
    depth_hints,
    ray_features,
    ray_neighbor_features,
)
from vpd_lightning.renderer.rays.volumetric import composite
from vpd_lightning.types import Particles, Rays, RenderedRays

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


class SurfaceRenderer(AbstractRenderer):
    """The paper's field at about ten samples per ray instead of 384.

    # Paper: one tier instead of two. Particles are projected on each ray; the ``num_candidates`` nearest say where
    # light is probably stopped, and they are all that the samples see. Of ``num_samples``, ``num_uniform_samples`` are
    # spread over [near, far], the others over ``hint_spread`` footprints before and behind the hints. Each sample
    # stands for a short interval (what lies between is taken as empty), and densities are per footprint, so that a raw
    # density of one stops a good part of the light on a surface. What no sample stops meets a learned background colour
    # of the viewing direction.

    ``footprint`` (metres) is how far across a ray a particle may stop light; ``None`` takes the narrowest kernel
    bandwidth, which the paper's tables set to about the distance between particles. ``kernel_normalization``,
    ``normalization_epsilon`` and ``feature_network`` make other features, see ``NeighborFeatures``.
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
        num_samples: int,
        num_uniform_samples: int,
        num_candidates: int,
        footprint: float | None,
        hint_spread: float,
        net_depth: int,
        net_width: int,
        skip_layer: int,
        net_width_condition: int,
        view_degree: int,
        density_activation: str,
        kernel_normalization: str | None,
        normalization_epsilon: float,
        feature_network: FeatureNetwork | None,
        background_width: int,
        ray_chunk_size: int,
        checkpoint_chunks: bool,
        candidate_backend: str,
    ) -> None:
        super().__init__()
        check_kernels(kernel_radii, kernel_bandwidths)
        check_backend(candidate_backend)
        if not 0 <= near < far:
            raise ValueError(f"near and far must satisfy 0 <= near < far, got near={near} and far={far}.")
        if not 0 <= num_uniform_samples < num_samples:
            raise ValueError(
                f"num_uniform_samples must be at least 0 and less than num_samples={num_samples}, "
                f"got {num_uniform_samples}."
            )
        if not 1 <= num_neighbors <= num_candidates:
            raise ValueError(f"num_neighbors must be from 1 to num_candidates={num_candidates}, got {num_neighbors}.")
        counts = {"feature_dim": feature_dim, "background_width": background_width, "ray_chunk_size": ray_chunk_size}
        for name, value in counts.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}.")
        self.footprint = float(min(kernel_bandwidths) if footprint is None else footprint)
        if not (self.footprint > 0 and hint_spread > 0):
            raise ValueError(f"footprint and hint_spread must be greater than 0, got {footprint} and {hint_spread}.")
        self.variant = NeighborFeatures(
            feature_dim=feature_dim,
            kernel_radii=kernel_radii,
            kernel_bandwidths=kernel_bandwidths,
            kernel_normalization=kernel_normalization,
            normalization_epsilon=normalization_epsilon,
            feature_network=feature_network,
        )
        self.num_neighbors, self.num_candidates = num_neighbors, num_candidates
        self.num_samples, self.num_uniform_samples = num_samples, num_uniform_samples
        self.kernel_radii = tuple(float(radius) for radius in kernel_radii)
        self.kernel_bandwidths = tuple(float(bandwidth) for bandwidth in kernel_bandwidths)
        self.near, self.far = float(near), float(far)
        self.hint_spread = float(hint_spread)
        self.view_degree = view_degree
        self.ray_chunk_size = ray_chunk_size
        self.checkpoint_chunks = checkpoint_chunks
        self.candidate_backend = candidate_backend
        self.field = RadianceField(
            input_dim=feature_dim * len(kernel_radii),
            net_depth=net_depth,
            net_width=net_width,
            skip_layer=skip_layer,
            net_width_condition=net_width_condition,
            view_degree=view_degree,
            density_activation=density_activation,
            initial_density=0.5,
        )
        self.background = nn.Sequential(
            nn.Linear(encoding_dim(view_degree), background_width), nn.ReLU(), nn.Linear(background_width, 3)
        )

    def forward(self, particles: Particles, rays: Rays, keys: RandomKeys | None) -> RenderedRays:
        """Render ``rays`` (``batch ray 3``); there is no coarse tier, so ``coarse_rgbs`` is ``None``.

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
        # One offset for all samples of a ray around the hints, one number for each uniform sample and each hint.
        shape = (num_rays, self.num_samples + 1)
        if keys is None:
            noise = rays.origins.new_full((batch_size, *shape), 0.5, dtype=torch.float32)
        else:
            noise = uniform_draws(keys, "render/surface", batch_size, shape, rays.origins)
        table = CandidateTable(particles, self.candidate_backend)
        found = table.closest(rays, self.num_candidates, self.near, self.far)
        parts = []
        for chunk in ray_slices(num_rays, batch_size, self.ray_chunk_size):
            some = Rays(rays.origins[:, chunk], rays.directions[:, chunk])
            candidates = table.seen_from(some, Candidates(found.index[:, chunk], found.mask[:, chunk]))
            parts.append(self._render(candidates, some, noise[:, chunk]))
        return joined(parts)

    def point_features(
        self, particles: Particles, queries: Float[Tensor, "batch query 3"]
    ) -> Float[Tensor, "batch query feature"]:
        """Return what the field is given at points of the scene (metres): there, all particles are candidates."""
        features = SampleFeatures(
            particles.with_driven().without_padding(),
            num_neighbors=self.num_neighbors,
            kernel_radii=self.kernel_radii,
            kernel_bandwidths=self.kernel_bandwidths,
            max_radius=None,
            neighbors_backend="auto",
            features_backend="auto",
            is_sorted=True,
            is_checkpointed=self.checkpoint_chunks,
            variant=self.variant,
        )
        return features(queries[:, :, None])[:, :, 0]

    def _render(self, candidates: RayCandidates, rays: Rays, noise: Float[Tensor, "batch ray draw"]) -> RenderedRays:
        t = self._samples(candidates, noise.to(candidates.along.dtype))
        directions = at_least_float32(rays.directions)

        def seen(along: Tensor, across: Tensor, latents: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
            some = RayCandidates(along, across, latents, candidates.mask, offsets)
            kernels = self.kernel_radii, self.kernel_bandwidths
            if self.variant.is_plain:
                features = ray_features(some, t, self.num_neighbors, *kernels, self.candidate_backend)
            else:
                features = ray_neighbor_features(some, t, directions, self.num_neighbors, self.variant)
            return self.field(features, directions)

        parts = candidates.along, candidates.across, candidates.features, candidates.offsets
        sigmas, rgbs = checkpointed(seen, *parts, is_enabled=self.checkpoint_chunks)
        t_starts, t_ends = self._intervals(t)
        rgb, weights, transmittance = composite(sigmas / self.footprint, rgbs, t_starts, t_ends)
        with full_precision(t):
            encoded = positional_encoding(directions, self.view_degree)
            background = torch.sigmoid(at_least_float32(self.background(encoded)))
            rgb = rgb + transmittance[..., None] * background
            depths = (weights * t).sum(dim=-1) + transmittance * self.far
        return RenderedRays(rgb, depths, 1.0 - transmittance)

    @torch.no_grad()
    def _samples(
        self, candidates: RayCandidates, noise: Float[Tensor, "batch ray draw"]
    ) -> Float[Tensor, "batch ray sample"]:
        """Return ascending distances: some around the depth hints, some uniform; constants of the backward pass."""
        num_hints = self.num_samples - self.num_uniform_samples
        steps = torch.arange(num_hints, device=noise.device, dtype=noise.dtype)
        hints = depth_hints(candidates, (steps + noise[..., 1 : num_hints + 1]) / num_hints, self.footprint)
        # A golden-ratio sequence: whichever run of samples shares one hint, its offsets are spread out evenly.
        offsets = 2 * torch.frac((steps + 0.5) * _GOLDEN + noise[..., :1]) - 1
        t = hints + self.hint_spread * self.footprint * offsets
        if self.num_uniform_samples:
            draws = noise[..., num_hints + 1 :]
            strata = torch.linspace(self.near, self.far, self.num_uniform_samples + 1, device=t.device, dtype=t.dtype)
            t = torch.cat([t, strata[:-1] + (strata[1:] - strata[:-1]) * draws], dim=-1)
        return t.clamp(self.near, self.far).sort(dim=-1).values

    def _intervals(
        self, t: Float[Tensor, "batch ray sample"]
    ) -> tuple[Float[Tensor, "batch ray sample"], Float[Tensor, "batch ray sample"]]:
        """Each sample stands for the way to the middle of its neighbours, but for no more than its share of a hint."""
        reach = 2 * self.hint_spread * self.footprint / (self.num_samples - self.num_uniform_samples)
        middles = (t[..., 1:] + t[..., :-1]) / 2
        first, last = torch.full_like(t[..., :1], -torch.inf), torch.full_like(t[..., :1], torch.inf)
        t_starts = torch.maximum(torch.cat([first, middles], dim=-1), t - reach)
        t_ends = torch.minimum(torch.cat([middles, last], dim=-1), t + reach)
        return t_starts, t_ends
