"""One network evaluation per ray: two depth layers of nearby particles, composited over a learned background."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from vpd_lightning.finite import require_finite
from vpd_lightning.geometry.decay import decay
from vpd_lightning.geometry.occluders import MOST_OCCLUDERS, occluders_of, thinned
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.background import DARKEST, Background, UnseenGround
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.renderer.kernel_weights import kernel_weights
from vpd_lightning.renderer.kernels.ray_search import RaySearch, check_backend
from vpd_lightning.renderer.observed_light import ObservedScenery, light_then, observed_light
from vpd_lightning.renderer.rays.ray_scores import BesideAndBehind
from vpd_lightning.renderer.scenery_layer import SceneryLayer, SeenScenery
from vpd_lightning.renderer.shadows import Shadows
from vpd_lightning.types import Occluders, Particles, Rays, RenderedRays, Scenery

_GROUND_LENGTH = 20.0
"""Surface scales over which the ground network resolves positions; farther out they are contracted."""


class _Layers(NamedTuple):
    """The front and the back layer of rays; distances along them in metres."""

    colors: Float[Tensor, "batch ray 2 3"]
    alphas: Float[Tensor, "batch ray 2"]
    distances: Float[Tensor, "batch ray 2"]


class SplatRenderer(AbstractRenderer):
    """Renders each ray from the particles nearest to it.

    The ``num_candidates`` particles closest to the ray (perpendicular distance, hidden ones last) fall softly into a
    front layer and a back layer by their distance along the ray. Each layer gives the network its mean features under
    Gaussian kernels of ``kernel_scales``, the mean offset from the ray (whether the ray passes beside a silhouette),
    and its density. The network returns two colours and two opacities; a background of the view direction closes the
    ray. With ``color_features`` the first three features of a particle are its colour, and the network predicts how a
    layer differs from their mean under the first kernel. A ray with no particle in front of its camera shows the
    background alone.

    With ``has_scenery`` and particles that have some, the ray shows that behind the moving particles (see
    ``SceneryLayer``) instead of the background, in the shadows of what moves (of at most ``num_occluders`` points)
    from ``num_lights`` lights (``Shadows``): its colours are those observed, times the light that reaches them now over
    the light then. What is deleted or moved takes its shadow along. With ``far_pixels`` what lay beyond every measured
    distance, such as the sky, is drawn behind it as it was seen (``far_pixels.py``), and with ``unseen_ground`` the
    floor and the sky go on where no input camera saw them (``background.py``). ``facing_softness`` (a cosine) fades
    particles whose normals face away from the camera, so that the far side of a body does not shine through; null
    leaves them.

    ``surface_scale`` is in metres: about as far as a surface reaches beside and behind a particle on it.
    ``kernel_scales`` (widths beside the ray), ``layer_depth`` (along it) and ``shadow_softness`` (before training) are
    multiples of it.
    """

    # Paper: renders by volume integration of a radiance field (renderer/point_nerf.py); this one is ours.

    def __init__(
        self,
        *,
        feature_dim: int,
        color_features: bool,
        background_frequencies: int,
        hidden_dim: int,
        num_layers: int,
        num_candidates: int,
        surface_scale: float,
        kernel_scales: Sequence[float],
        layer_depth: float,
        near: float,
        far: float,
        ray_chunk_size: int,
        candidate_backend: str,
        facing_softness: float | None,
        has_scenery: bool,
        num_scenery_candidates: int,
        elliptic_footprints: bool,
        far_pixels: bool,
        seen_through: bool,
        unseen_ground: bool,
        num_lights: int,
        num_occluders: int,
        shadow_softness: float,
    ):
        super().__init__()
        check_backend(candidate_backend)
        if min(*kernel_scales, layer_depth, surface_scale) <= 0:
            raise ValueError(
                "kernel_scales, layer_depth and surface_scale must be positive, got "
                f"{list(kernel_scales)}, {layer_depth} and {surface_scale}"
            )
        if background_frequencies < 0:
            raise ValueError(f"background_frequencies must be at least 0, got {background_frequencies}")
        if num_candidates < 1 or ray_chunk_size < 1:
            raise ValueError(
                f"num_candidates and ray_chunk_size must be at least 1, got {num_candidates}, {ray_chunk_size}"
            )
        if facing_softness is not None and facing_softness <= 0:
            raise ValueError(f"facing_softness must be positive or null, got {facing_softness}")
        if num_lights < 0 or num_scenery_candidates < 1 or not 1 <= num_occluders <= MOST_OCCLUDERS:
            raise ValueError(
                f"num_lights must be at least 0, num_scenery_candidates at least 1 and num_occluders from 1 to "
                f"{MOST_OCCLUDERS}, got {num_lights}, {num_scenery_candidates} and {num_occluders}"
            )
        if num_lights and not has_scenery:
            raise ValueError(f"num_lights={num_lights} cast shadows on the scenery: set scenery=true, or num_lights=0")
        if not 0 <= near < far:
            raise ValueError(f"near must lie in [0, far), got near={near}, far={far}")
        self.num_candidates, self.near, self.far = num_candidates, near, far
        self.candidate_backend, self.ray_chunk_size = candidate_backend, ray_chunk_size
        # In metres from here on.
        self.kernel_scales = [surface_scale * scale for scale in kernel_scales]
        self.layer_depth = surface_scale * layer_depth
        num_scales = len(self.kernel_scales)
        layer_dim = num_scales * (feature_dim + 4) + 1
        widths = [2 * layer_dim + 3, *[hidden_dim] * num_layers]
        layers: list[nn.Module] = []
        for i, o in zip(widths[:-1], widths[1:], strict=True):
            layers += [nn.Linear(i, o), nn.ReLU()]
        last = nn.Linear(hidden_dim, 8)
        self.network = nn.Sequential(*layers, last)
        self.color_features = color_features
        if color_features:  # before training, a layer has the mean colour of its particles
            with torch.no_grad():
                last.weight[:6], last.bias[:6] = 0, 0
                if not has_scenery:  # and one opacity; a random one may fall to 0 everywhere before colours are right
                    last.weight[6:], last.bias[6:] = 0, 0
        self.background = Background(frequencies=background_frequencies, hidden_dim=hidden_dim)
        self.facing_softness, self.num_occluders = facing_softness, num_occluders
        self.scenery: SceneryLayer | None = None
        self.shadows: Shadows | None = None
        self.unseen_ground: UnseenGround | None = None
        self._kept: tuple[tuple[Any, ...], ObservedScenery] | None = None
        if has_scenery:
            self.scenery = SceneryLayer(
                num_candidates=num_scenery_candidates,
                near=near,
                backend=candidate_backend,
                elliptic=elliptic_footprints,
                far_pixels=far_pixels,
                seen_through=seen_through,
            )
            if num_lights:
                self.shadows = Shadows(num_lights=num_lights, softness=surface_scale * shadow_softness)
            if unseen_ground:
                self.unseen_ground = UnseenGround(
                    frequencies=background_frequencies,
                    hidden_dim=hidden_dim,
                    length=surface_scale * _GROUND_LENGTH,
                    near=near,
                )

    def forward(self, particles: Particles, rays: Rays, keys: RandomKeys | None) -> RenderedRays:
        """Render rays (``batch ray 3``); nothing here is random, so ``keys`` is not used.

        The scenery of the particles may have a shorter batch axis, which divides theirs: each of its members is then
        that of as many successive ones of theirs, as with the time steps of a clip.
        """
        seen = self._seen_scenery(particles, rays)
        if seen is not None and particles.moving is not None:
            particles = replace(particles, mask=particles.mask & particles.moving)
        particles = particles.with_hidden_side().with_driven()
        particles = particles.without_padding()
        require_finite(
            "Rendering",
            positions=particles.positions,
            features=particles.features,
            rays=torch.cat([rays.origins, rays.directions]),
        )
        num_rays = rays.origins.shape[1]
        if particles.num_particles == 0:  # maxima and products need something to work on
            pad = nn.functional.pad
            particles = Particles(
                positions=pad(particles.positions, (0, 0, 0, 1)),
                features=pad(particles.features, (0, 0, 0, 1)),
                mask=pad(particles.mask, (0, 1)),
            )  # without normals: there is nothing to face
        index = self._candidates(particles, rays.origins, rays.directions)
        if seen is not None:
            return self._before_scenery(particles, index, rays, seen)
        chunks = []
        for some in self._chunks(num_rays):
            lines = Rays(rays.origins[:, some], rays.directions[:, some])
            layers = self._rendered_layers(particles, index[:, some], lines, has_scenery=False)
            far = torch.full_like(layers.distances[..., :1], self.far)
            chunks.append(_composited(layers, self.background(lines.directions), far, torch.zeros_like(far)))
        return _joined(chunks)

    def _before_scenery(self, particles: Particles, index: Tensor, rays: Rays, seen: SeenScenery) -> RenderedRays:
        """Render moving particles before the scenery: by the network only where a ray passes near one."""
        opacity, distance = seen.opacities[..., None], seen.distances[..., None]
        behind = opacity * seen.colors + (1 - opacity) * seen.behind
        far = opacity * distance + (1 - opacity) * self.far
        rendered = RenderedRays(behind, far.squeeze(-1), seen.opacities)
        is_near = self._passing_near(particles, index, rays).flatten()
        rows = is_near.nonzero().flatten()
        if len(rows) == 0:  # one ray all the same, so that each weight has a gradient, as on several devices it must
            rows = rows.new_zeros(min(1, opacity.numel()))
        # All members as one, whose rays are the chosen ones.
        batch = torch.arange(len(index), device=index.device)[:, None, None]
        index = torch.where(index >= 0, index + batch * particles.num_particles, -1).flatten(0, 1)
        as_one = particles.mapped(lambda values: values.flatten(0, 1)[None])
        flat = [part.flatten(0, 1) for part in (rays.origins, rays.directions, behind, far, opacity, distance)]
        chunks = []
        for chunk in self._chunks(len(rows)):
            some = rows[chunk]
            origins, directions, *parts = (part.index_select(0, some)[None] for part in flat)
            behind, far, opacity, distance = parts
            layers = self._rendered_layers(as_one, index.index_select(0, some)[None], Rays(origins, directions), True)
            # Scenery in front hides a layer; a body that stands on it is as far away as it is.
            hidden = opacity * torch.sigmoid((layers.distances - distance) / (0.1 * self.layer_depth) - 5.0)
            layers = layers._replace(alphas=layers.alphas * (1 - hidden) * is_near[some][None, :, None])
            chunks.append(_composited(layers, behind, far, opacity))
        found = _joined(chunks)

        def put(values: Tensor, new: Tensor) -> Tensor:
            return values.flatten(0, 1).index_copy(0, rows, new[0].to(values.dtype)).view_as(values)

        return RenderedRays(
            put(rendered.rgbs, found.rgbs), put(rendered.depths, found.depths), put(rendered.opacities, found.opacities)
        )

    @torch.no_grad()
    def _passing_near(self, particles: Particles, index: Tensor, rays: Rays) -> Bool[Tensor, "batch ray"]:
        """Return which rays pass within the widest kernel's width of a moving particle; others cannot meet one."""
        batch = torch.arange(len(index), device=index.device)[:, None, None]
        flat = (batch * particles.num_particles + index.clamp(min=0)).flatten()
        offsets = particles.positions.flatten(0, 1).index_select(0, flat).unflatten(0, index.shape)
        offsets = offsets - rays.origins[:, :, None]
        along = (offsets * rays.directions[:, :, None]).sum(dim=-1)
        square = offsets.square().sum(dim=-1) - along.square()
        return ((square < max(self.kernel_scales) ** 2) & (index >= 0)).any(dim=-1)

    def _chunks(self, num_rays: int) -> list[slice]:
        return [slice(s, s + self.ray_chunk_size) for s in range(0, max(num_rays, 1), self.ray_chunk_size)]

    def _rendered_layers(self, particles: Particles, index: Tensor, rays: Rays, has_scenery: bool) -> _Layers:
        """Return what the network makes of the front and the back layer of each ray."""
        origins, directions = rays.origins, rays.directions
        with torch.autocast(origins.device.type, enabled=False):
            inputs, depth, sees_any = self._layers(particles, index, origins, directions)
        outputs = self.network(torch.cat([inputs, directions], dim=-1)).to(origins.dtype)
        logits = outputs[..., :6].unflatten(-1, (2, 3))
        if self.color_features:
            means = inputs.unflatten(-1, (2, -1))[..., :3].to(logits.dtype)
            logits = logits + torch.logit(means.clamp(DARKEST, 1 - DARKEST))
        before_training = self._coverage(inputs) if has_scenery else 1.0
        return _Layers(torch.sigmoid(logits), torch.sigmoid(outputs[..., 6:] + before_training) * sees_any, depth)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_kept": None}  # copies and files have no use for it

    def _seen_scenery(self, particles: Particles, rays: Rays) -> SeenScenery | None:
        """Return the scenery along the rays in the shadows of the particles that move now."""
        scenery = particles.scenery
        if self.scenery is None or scenery is None:
            return None
        repeats = len(rays.origins) // max(len(scenery.positions), 1)

        def per_clip(tensor: Tensor) -> Tensor:
            return tensor.unflatten(0, (-1, repeats)).flatten(1, 2)

        with torch.autocast(rays.origins.device.type, enabled=False):
            clip_rays = Rays(per_clip(rays.origins), per_clip(rays.directions))
            unlit = self._unlit(scenery, rays, clip_rays)
            colors, points = unlit.seen.colors, unlit.points
            if self.shadows is not None:
                casting = thinned(occluders_of(particles), self.num_occluders)
                now = self.shadows(points.unflatten(1, (repeats, -1)).flatten(0, 1), casting.positions, casting.mask)
                now = per_clip(now)
                lit = colors * now / light_then(unlit.predicted, unlit.corrected, now)
                colors = lit + (lit.clamp(max=1) - lit).detach()  # what is too bright still learns to be less so
            parts = unlit.seen._replace(colors=colors)
            return SeenScenery(*(part.unflatten(1, (repeats, -1)).flatten(0, 1) for part in parts))

    def _unlit(self, scenery: Scenery, rays: Rays, clip_rays: Rays) -> ObservedScenery:
        """Return what does not change with what moves.

        Without gradients it is kept for the next call: a camera that stands still sees the same at every step.
        """
        assert self.scenery is not None
        parts = (self.scenery, self.shadows, self.background, self.unseen_ground)
        weights = [weight for part in parts if part is not None for weight in part.parameters()]
        held = [scenery, rays.origins, rays.directions]
        read = [*weights, *held[1:], *(getattr(scenery, item.name) for item in fields(scenery))]
        key = (
            held,
            self.training,
            [tensor.dtype for tensor in read],
            [0 if t.is_inference() else t._version for t in read],
        )
        if self._kept is not None and not torch.is_grad_enabled():
            kept, found = self._kept
            if all(one is other for one, other in zip(held, kept[0], strict=True)) and key[1:] == kept[1:]:
                return found
        background, ground = self.background(clip_rays.directions), None
        if self.unseen_ground is not None:
            background, ground = self.unseen_ground(scenery, clip_rays, background)
        seen = self.scenery(scenery, clip_rays, background, ground)
        points = clip_rays.origins + seen.distances[..., None] * clip_rays.directions
        predicted = corrected = torch.ones_like(points)
        if self.shadows is not None:
            casting = thinned(Occluders(scenery.occluders, scenery.occluder_mask), self.num_occluders)
            predicted = corrected = self.shadows(points, casting.positions, casting.mask)
            if not self.training:  # training is to see where the prediction is wrong
                corrected = observed_light(self.shadows, scenery, casting, seen, points, predicted)
        found = ObservedScenery(seen, points, predicted, corrected)
        self._kept = None if torch.is_grad_enabled() else (key, found)
        return found

    def _coverage(self, inputs: Tensor) -> Float[Tensor, "batch ray 2"]:
        """Return the logit that a layer stops the ray before training: yes within about the middle kernel's width.

        Without scenery a ray beside a body meets other particles; with it, it must pass.
        """
        num_scales = len(self.kernel_scales)
        visible = inputs.unflatten(-1, (2, -1))[..., :-1].unflatten(-1, (num_scales, -1))[..., num_scales // 2, -1]
        return 3.0 + 20.0 * visible

    def _layers(
        self, particles: Particles, index: Tensor, origins: Tensor, directions: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the network's inputs (``batch ray input``), the layers' distances, and whether there is a particle."""
        batch = torch.arange(len(index), device=index.device)[:, None, None]
        flat = (batch * particles.num_particles + index.clamp(min=0)).flatten()

        def gather(values: Tensor) -> Tensor:  # index_select: its backward is an index_add, much the fastest on CPU
            return values.flatten(0, 1).index_select(0, flat).unflatten(0, index.shape)

        offsets = gather(particles.positions) - origins[:, :, None]
        along = (offsets * directions[:, :, None]).sum(dim=-1)
        beside = offsets - along[..., None] * directions[:, :, None]
        square = beside.square().sum(dim=-1)
        usable = gather(particles.mask[..., None]).squeeze(-1) & (along > self.near) & (index >= 0)
        front = self._front(along, square, usable)
        in_front = (front + self.layer_depth - along) / (0.3 * self.layer_depth)
        memberships = nn.functional.logsigmoid(torch.stack([in_front, -in_front], dim=2)).clamp(min=-30.0)
        if self.facing_softness is not None and particles.normals is not None:
            # A face that is turned away is not seen through the body; what has no normal may face anywhere.
            facing = (gather(particles.normals) * directions[:, :, None]).sum(dim=-1)
            hidden = nn.functional.logsigmoid(-facing / self.facing_softness).clamp(min=-30.0)
            known = gather(particles.normals).square().sum(dim=-1) > 0.5
            memberships = memberships + torch.where(known, hidden, 0.0)[:, :, None]
        # What cannot be used, in particular what is behind the camera, counts for nothing at all.
        memberships = memberships.masked_fill(~usable[:, :, None], -1e30)
        scales = torch.tensor(self.kernel_scales, dtype=along.dtype, device=along.device)
        weights, log_total = kernel_weights(memberships, square, usable, scales)
        # One product for all layers and scales: (layer * scale, candidate) @ (candidate, channel) of each ray.
        features, offsets = (
            (weights.flatten(2, 3) @ values).unflatten(2, weights.shape[2:4])
            for values in (gather(particles.features), beside)
        )
        distances = (weights[:, :, :, 0] * along[:, :, None]).sum(dim=-1)
        visible = log_total.clamp(min=-10.0) / 5
        density = torch.log1p((decay(memberships) * usable[:, :, None]).sum(dim=-1, keepdim=True))
        inputs = torch.cat([features, offsets / scales[:, None], visible], dim=-1).flatten(3)
        inputs = torch.cat([inputs, density], dim=-1).flatten(2)
        return inputs, distances, usable.any(dim=-1, keepdim=True)

    @torch.no_grad()
    def _front(self, along: Tensor, square: Tensor, usable: Tensor) -> Float[Tensor, "batch ray 1"]:
        """Return where the front begins: the nearest candidate, each set back by how far it is beside the ray.

        It only places the soft border between the two layers, so no gradient passes through it.
        """
        set_back = along + 2 * square.sqrt()
        return set_back.masked_fill(~usable, self.far).amin(dim=-1, keepdim=True)

    @torch.no_grad()
    def _candidates(
        self, particles: Particles, origins: Tensor, directions: Tensor
    ) -> Int[Tensor, "batch ray candidate"]:
        """Choose the particles closest to each ray, hidden ones last, none behind the camera; -1 for none."""
        score = BesideAndBehind(self.near, 0.5 * self.kernel_scales[-1], 3 * self.layer_depth)
        count = min(self.num_candidates, particles.num_particles)
        search = RaySearch(particles.positions, particles.mask, self.candidate_backend)
        found = search.closest(origins, directions, count, score)
        return torch.where(found.mask, found.index, -1)


def _composited(layers: _Layers, behind: Tensor, far: Tensor, opacity: Tensor) -> RenderedRays:
    """Return the layers before something of a colour, a distance and an opacity (the latter two ``batch ray 1``)."""
    front, back = layers.alphas[..., :1], (1 - layers.alphas[..., :1]) * layers.alphas[..., 1:]
    left = 1 - front - back
    rgbs = front * layers.colors[..., 0, :] + back * layers.colors[..., 1, :] + left * behind
    depths = (front * layers.distances[..., :1] + back * layers.distances[..., 1:] + left * far).squeeze(-1)
    return RenderedRays(rgbs, depths, (front + back + left * opacity).squeeze(-1))


def _joined(chunks: Sequence[RenderedRays]) -> RenderedRays:
    rgbs, depths, opacities = (
        torch.cat([getattr(chunk, name) for chunk in chunks], dim=1) for name in ("rgbs", "depths", "opacities")
    )
    return RenderedRays(rgbs, depths, opacities)
