"""A radiance field of the whole scene, conditioned on one scene vector (Li et al. 2021)."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.finite import require_finite
from vpd_lightning.graph.pooling import mean_features
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.renderer.field.positional_encoding import encoding_dim, positional_encoding
from vpd_lightning.renderer.field.precision import at_least_float32, full_precision
from vpd_lightning.renderer.field.radiance_field import RadianceField
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


class GlobalNeRFRenderer(AbstractRenderer):
    """jaxnerf's two tiers on the encoded place of each sample and the scene vector, as NeRF-dy's decoder.

    The networks see ``[gamma(x), sqrt(feature_dim) s]``: ``gamma`` has ``position_degree`` octaves of ``x``, scaled so
    that the workspace box is [-1, 1] (places outside of it are not clamped), and ``s`` is the feature of the scene's
    one particle (of several, the mean; without any, zero). The root makes the entries of a unit vector about as large
    as those of ``gamma``. Positions of particles are not looked at. Samples, tiers and compositing are those of
    ``PointNeRFRenderer``; the coarse tier takes its colour straight from the trunk, as jaxnerf.

    What the two layers that see ``s`` make of it is computed once per scene and chunk, not per sample: the same sum.

    Rays are rendered in chunks of about ``ray_chunk_size`` (``None``: by device, see ``automatic_chunk_size``), counted
    over the batch axis. With ``checkpoint_chunks`` activations are computed again in the backward pass, with exact
    gradients; the places of the samples are kept.
    """

    # Paper: "a NeRF conditioned on the latent" and no more; sizes, tiers and encodings are those of the paper's own
    # renderer, with NeRF's ten octaves of the place, which that one does not need. The root is ours: with entries of
    # 1/16 the scenes' vectors hardly influenced the image, and in training they collapsed to a single one.
    # Paper: VPD's coarse tier has the layer of 128 before its colour; this one takes its colour from the trunk, as
    # jaxnerf does without view directions. The coarse colour is trained on and never shown.

    def __init__(
        self,
        *,
        feature_dim: int,
        workspace_min: Sequence[float],
        workspace_max: Sequence[float],
        near: float,
        far: float,
        num_coarse_samples: int,
        num_fine_samples: int,
        net_depth: int,
        net_width: int,
        skip_layer: int,
        net_width_condition: int,
        position_degree: int,
        view_degree: int,
        density_activation: str,
        ray_chunk_size: int | None,
        checkpoint_chunks: bool,
    ) -> None:
        super().__init__()
        if any(low >= high for low, high in zip(workspace_min, workspace_max, strict=True)):
            raise ValueError(f"workspace_min {list(workspace_min)} must lie below workspace_max {list(workspace_max)}.")
        if not 0 <= near < far:
            raise ValueError(f"near and far must satisfy 0 <= near < far, got near={near} and far={far}.")
        least = {"feature_dim": (feature_dim, 1), "num_coarse_samples": (num_coarse_samples, 3)}
        least |= {"num_fine_samples": (num_fine_samples, 1), "position_degree": (position_degree, 0)}
        if ray_chunk_size is not None:
            least["ray_chunk_size"] = (ray_chunk_size, 1)
        for name, (value, smallest) in least.items():
            if value < smallest:
                raise ValueError(f"{name} must be at least {smallest}, got {value}.")
        self.center = tuple((low + high) / 2 for low, high in zip(workspace_min, workspace_max, strict=True))
        self.half_sides = tuple((high - low) / 2 for low, high in zip(workspace_min, workspace_max, strict=True))
        self.near, self.far = float(near), float(far)
        self.num_coarse_samples, self.num_fine_samples = num_coarse_samples, num_fine_samples
        self.position_degree = position_degree
        self.ray_chunk_size, self.checkpoint_chunks = ray_chunk_size, checkpoint_chunks

        def field(width: int | None, degree: int | None) -> RadianceField:
            return RadianceField(
                input_dim=encoding_dim(position_degree) + feature_dim,
                net_depth=net_depth,
                net_width=net_width,
                skip_layer=skip_layer,
                net_width_condition=width,
                view_degree=degree,
                density_activation=density_activation,
                # An optical depth of one over the whole ray: everything is seen, nothing is hidden.
                initial_density=1.0 / (far - near),
            )

        self.coarse = field(None, None)
        self.fine = field(net_width_condition, view_degree)

    def forward(self, particles: Particles, rays: Rays, keys: RandomKeys | None) -> RenderedRays:
        """Render ``rays`` (``batch ray 3``); ``coarse_rgbs`` is there in training mode and wherever gradients are.

        Raises:
            NonFiniteError: when a feature or a ray is not finite.
            ValueError: when ``keys`` do not name one sample per member of the batch axis.
        """
        scenes = mean_features(particles) * particles.features.shape[-1] ** 0.5
        require_finite("Rendering", features=scenes, rays=torch.cat([rays.origins, rays.directions]))
        batch_size, num_rays = rays.origins.shape[:2]
        # All random numbers are drawn here, so that neither chunks nor recomputation change them.
        noise = quantiles = None
        if keys is not None:
            shape = (num_rays, self.num_coarse_samples)
            noise = uniform_draws(keys, "render/stratified", batch_size, shape, rays.origins)
            shape = (num_rays, self.num_fine_samples)
            quantiles = uniform_draws(keys, "render/importance", batch_size, shape, rays.origins)
        chunk_size = self.ray_chunk_size or automatic_chunk_size(rays.origins.device)
        parts = [
            self._render(
                scenes,
                at_least_float32(rays.origins[:, chunk]),
                at_least_float32(rays.directions[:, chunk]),
                None if noise is None else noise[:, chunk],
                None if quantiles is None else quantiles[:, chunk],
            )
            for chunk in ray_slices(num_rays, batch_size, chunk_size)
        ]
        return joined(parts)

    def _render(
        self,
        scenes: Float[Tensor, "batch latent"],
        origins: Float[Tensor, "batch ray 3"],
        directions: Float[Tensor, "batch ray 3"],
        noise: Float[Tensor, "batch ray coarse"] | None,
        quantiles: Float[Tensor, "batch ray fine"] | None,
    ) -> RenderedRays:
        # Coarse: where is light stopped?
        t_coarse = coarse_samples(origins, self.near, self.far, self.num_coarse_samples, noise)
        needs_color = self.training or torch.is_grad_enabled()
        points = points_along(origins, directions, t_coarse)
        sigmas, rgbs = self._evaluate(self.coarse, points, None, scenes, needs_color)
        weights, transmittance = ray_weights(sigmas, t_coarse, interval_ends(t_coarse, self.far))
        coarse_rgbs = None if rgbs is None else closed_color(weights, transmittance, rgbs)
        # Fine: the same samples, and more of them there.
        t_fine = fine_samples(t_coarse, weights.detach(), self.num_fine_samples, quantiles)
        t = torch.cat([t_coarse, t_fine], dim=-1).sort(dim=-1).values
        points = points_along(origins, directions, t)
        return composited_rays(*self._evaluate(self.fine, points, directions, scenes, True), t, self.far, coarse_rgbs)

    def _evaluate(
        self,
        field: RadianceField,
        points: Float[Tensor, "batch ray sample 3"],
        directions: Float[Tensor, "batch ray 3"] | None,
        scenes: Float[Tensor, "batch latent"],
        use_color: bool,
    ) -> tuple[Tensor, Any]:
        def network(points: Tensor, scenes: Tensor) -> tuple[Tensor, Tensor | None]:
            return field(self._encoded(points), directions, use_color, scenes)

        return checkpointed(network, points, scenes, is_enabled=self.checkpoint_chunks)

    def _encoded(self, points: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape encoding"]:
        with full_precision(points):
            places = (points - points.new_tensor(self.center)) / points.new_tensor(self.half_sides)
            return positional_encoding(places, self.position_degree)
