"""What a ray sees of the scenery: colour, distance and opacity from the points nearest to it, in today's shadows."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from vpd_lightning.geometry.decay import decay
from vpd_lightning.renderer.far_pixels import seen_far
from vpd_lightning.renderer.kernels.ray_search import RaySearch
from vpd_lightning.renderer.rays.ray_scores import BesideAndBehind, BesideRay
from vpd_lightning.types import Rays, Scenery

_REACH, _REACH_ELLIPTIC = 2.0, 1.5
"""Pixel widths beside the nearest point up to which a ray still meets its surface: round, and elliptic footprints."""

_EDGE, _EDGE_ELLIPTIC = 8.0, 16.0
"""How sharply a surface ends there, per pixel width: between pixels, 0.7 from the nearest, nothing shines through."""

_STEEPEST = 4.0
"""Most widths that a pixel seen at a grazing angle counts along the surface; twice as many where footprints are
elliptic."""


_CLOSER, _SEEN_ALONG = 0.3, 0.2
"""Pixel widths by which a ray may pass another point more closely and still meet a surface, and the angle (radians)
from how that point was seen at which it counts as one width farther off."""

_NUM_BESIDE, _FAR = 2, 1e9


class SeenScenery(NamedTuple):
    """The scenery along rays, as it was observed, and what is ``behind`` it; distances in metres."""

    colors: Float[Tensor, "batch ray 3"]
    distances: Float[Tensor, "batch ray"]
    opacities: Float[Tensor, "batch ray"]
    behind: Float[Tensor, "batch ray 3"]


def _seen_beside(
    offsets: Float[Tensor, "batch ray candidate 3"], views: Float[Tensor, "batch ray candidate 3"]
) -> Float[Tensor, "batch ray candidate"]:
    """Return how far beside a point another lies as the camera that saw the point looks at it (metres).

    So what a pixel covers of a surface is as long as it was seen at a grazing angle, and no wider; from the camera
    that saw it, it is that pixel. At most ``2 * _STEEPEST`` widths long: beyond, distance itself counts.
    """
    depth = (offsets * views).sum(dim=-1, keepdim=True)
    across = (offsets - depth * views).square().sum(dim=-1)
    far = offsets.square().sum(dim=-1) / (2 * _STEEPEST) ** 2
    return torch.maximum(across, far).clamp(min=1e-20).sqrt()


class SceneryLayer(nn.Module):
    """The mean colour of the ``num_candidates`` points nearest to each ray.

    A point counts more the nearer it is to the ray (in widths of the pixel that saw it, times a learned one), the more
    the ray looks the way in which it was seen (a learned angle: reflections and exposure differ between cameras), and
    the finer it was seen; not where it faces away, nor behind another surface. The ray meets the tangent planes of the
    points, so a floor has its exact depth. Near is what the camera that saw a point sees near it: the footprint of a
    pixel is an ellipse on its plane (as in EWA splatting, Zwicker et al. 2001); where not ``elliptic`` it is a disc as
    wide as that ellipse is long. With ``seen_through`` a surface ends where a camera saw past it: a ray that passes a
    point of what is behind more closely, and along the way it was seen, does not meet what reaches beside that. With
    ``far_pixels`` a ray also sees, behind the points, the pixels that measured no distance, in whose direction it
    leads.
    """

    def __init__(
        self,
        *,
        num_candidates: int,
        near: float,
        backend: str,
        elliptic: bool,
        far_pixels: bool,
        seen_through: bool,
    ):
        super().__init__()
        self.far_pixels, self.seen_through = far_pixels, seen_through
        self.num_candidates, self.near, self.backend, self.elliptic = num_candidates, near, backend, elliptic
        self.log_width = nn.Parameter(torch.tensor(math.log(0.5)))  # of a pixel
        self.log_angle = nn.Parameter(torch.tensor(math.log(0.2)))  # radians

    def forward(
        self,
        scenery: Scenery,
        rays: Rays,
        background: Float[Tensor, "batch ray 3"] | None = None,
        ground: Float[Tensor, "batch ray"] | None = None,
    ) -> SeenScenery:
        """Look along the rays (``batch ray 3``, the scenery's batch axis), before a background: black if not given.

        Where ``ground``, the share of the background that is ground, is given, far pixels go on where there is none:
        a body stood before them.
        """
        index = self._candidates(scenery, rays)
        batch = torch.arange(len(index), device=index.device)[:, None, None]
        flat = (batch * scenery.positions.shape[1] + index.clamp(min=0)).flatten()

        def gather(values: Tensor) -> Tensor:
            return values.flatten(0, 1).index_select(0, flat).unflatten(0, index.shape)

        normals, views, sizes = gather(scenery.normals), gather(scenery.views), gather(scenery.sizes)
        directions = rays.directions[:, :, None]
        offsets = gather(scenery.positions) - rays.origins[:, :, None]
        along = (offsets * directions).sum(dim=-1)
        beside = (offsets - along[..., None] * directions).square().sum(dim=-1).clamp(min=1e-20).sqrt()
        usable = (index >= 0) & (along > self.near)
        facing = (normals * directions).sum(dim=-1)
        known = normals.square().sum(dim=-1) > 0.5
        usable = usable & ~(known & (facing > 0))
        # Where the ray meets the point's tangent plane, as far as that is near the point.
        planar = known & (facing < -0.05)
        planes = (offsets * normals).sum(dim=-1) / torch.where(planar, facing, -1.0)
        met = torch.where(planar, planes, along)
        farthest = 4 * _STEEPEST * sizes
        met = along + (met - along).clamp(-farthest, farthest)
        if self.elliptic:
            spread = torch.where(planar, _seen_beside(met[..., None] * directions - offsets, views), beside)
            reach, most, edge = sizes, _REACH_ELLIPTIC, _EDGE_ELLIPTIC
        else:
            grazing = (normals * views).sum(dim=-1).abs().clamp(min=1 / _STEEPEST)
            spread, reach = beside, sizes / torch.where(known, grazing, 1.0)
            most, edge = _REACH, _EDGE
        turn = 2 - 2 * (views * directions).sum(dim=-1)  # about the square of the angle
        meets = usable
        if self.seen_through:
            apart = spread / reach
            closest = (apart + turn / _SEEN_ALONG**2).masked_fill(~usable, torch.inf).amin(-1, True)
            meets = usable & (apart < closest + _CLOSER)
        first = (met + 2 * (spread - most * reach).clamp(min=0)).masked_fill(~meets, torch.inf).amin(-1, True)
        depth = 3 * sizes
        shown = usable & (meets | (met > first - depth))
        before = nn.functional.logsigmoid((first.clamp(max=1e6) + depth - met) / (0.3 * depth))
        width = sizes * self.log_width.exp()
        logits = before - 0.5 * (spread / width).square() - 0.5 * turn * (-2 * self.log_angle).exp() - 2 * sizes.log()
        logits = logits.masked_fill(~shown, -1e30)
        kernels = decay(logits - logits.detach().amax(dim=-1, keepdim=True)) * shown
        weights = kernels / kernels.sum(dim=-1, keepdim=True).clamp(min=1e-30)
        colors = (weights[:, :, None] @ gather(scenery.colors)).squeeze(2)
        distances = (weights * met).sum(dim=-1)
        nearest = (spread / reach).masked_fill(~usable, 1e6).amin(dim=-1)
        opacities = torch.sigmoid(edge * (most - nearest))
        if background is None:
            background = torch.zeros_like(colors)
        if not self.far_pixels:
            return SeenScenery(colors, distances, opacities, background)
        far = seen_far(scenery, rays, self.log_width.exp(), self.backend)
        beyond = far.opacities[..., None]
        if ground is not None:
            beyond = beyond + (1 - beyond) * ((1 - ground) * far.going_on(nearest))[..., None]
        behind = beyond * far.colors + (1 - beyond) * background
        return SeenScenery(colors, distances, opacities * far.leaves(nearest), behind)

    @torch.no_grad()
    def _candidates(self, scenery: Scenery, rays: Rays) -> Int[Tensor, "batch ray candidate"]:
        """Choose the points closest to each ray, hidden ones last, none behind the camera; -1 for none.

        With ``seen_through`` those nearest beside it, however far behind, stand last.
        """
        sizes = torch.where(scenery.mask, scenery.sizes, torch.nan).nanmedian(dim=1).values
        chosen = []
        for member, width in enumerate(torch.nan_to_num(sizes, nan=1.0).tolist()):  # each has a width of its own
            some = slice(member, member + 1)
            score = BesideAndBehind(self.near, 1.5 * width, 8 * width)
            search = RaySearch(scenery.positions[some], scenery.mask[some], self.backend)
            found = search.closest(rays.origins[some], rays.directions[some], self.num_candidates, score)
            index = torch.where(found.mask, found.index, -1)
            if self.seen_through:  # what is far behind the first surface is not among those
                beside = BesideRay(self.near, _FAR)
                found = search.closest(rays.origins[some], rays.directions[some], _NUM_BESIDE, beside)
                is_new = found.mask & (found.index[..., None] != index[..., None, :]).all(dim=-1)
                index = torch.cat([index, torch.where(is_new, found.index, -1)], dim=-1)
            chosen.append(index)
        return torch.cat(chosen)
