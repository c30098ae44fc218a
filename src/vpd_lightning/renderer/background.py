"""What a ray shows where nothing was seen: by its direction, and by the place where it would meet the ground."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vpd_lightning.types import Rays, Scenery

_MOST_POINTS = 4096
"""Points of the scenery that a plane is looked for among: every n-th, for a plane that matters has many."""

_NUM_TRIED = 32
"""Tangent planes that are tried."""

_ALIGNED = 0.9
"""Smallest cosine between the normal of a plane and that of a point on it."""

_LEAST_SHARE = 0.3
"""Of the seen area, on the widest plane: with less there is no ground."""

_FADES = 0.05
"""Cosine below which the ground fades into the direction's colour: at its horizon a pixel covers all of it."""

DARKEST = 0.01
"""Colours nearer to 0 or 1 have no logit to add to."""


class Ground(NamedTuple):
    """The plane on which most of the scenery lies (floor, table top), and the mean colour seen on it.

    It is ``normals @ x = heights`` (metres), with the normal on the side from which it was seen. All that was seen of
    it lies within ``radii`` (metres) of ``centers``.
    """

    normals: Float[Tensor, "batch 3"]
    heights: Float[Tensor, " batch"]
    colors: Float[Tensor, "batch 3"]
    found: Bool[Tensor, " batch"]
    centers: Float[Tensor, "batch 3"]
    radii: Float[Tensor, " batch"]


@torch.no_grad()
def ground_of(scenery: Scenery) -> Ground:
    """Return the tangent plane with the largest seen area on it, moved to the mean of the points on it.

    A point lies on it within a pixel's width. A pixel's area is that of its footprint, so that a floor seen at a
    grazing angle counts as much as one seen from above.
    """
    some = slice(None, None, max(1, -(-scenery.positions.shape[1] // _MOST_POINTS)))
    known = scenery.mask[:, some] & (scenery.normals[:, some].square().sum(dim=-1) > 0.5)
    positions, normals, views, colors = (  # what is not known may hold anything
        torch.where(known[..., None], values[:, some], 0.0)
        for values in (scenery.positions, scenery.normals, scenery.views, scenery.colors)
    )
    sizes = torch.where(known, scenery.sizes[:, some], 0.0)
    grazing = (normals * views).sum(dim=-1).abs().clamp(min=0.05)
    areas = sizes.square() / grazing
    # Of the known points, as many as there are to try, evenly over their places in the cloud.
    count = known.sum(dim=1, keepdim=True)
    rank = torch.arange(_NUM_TRIED, device=positions.device) * count // _NUM_TRIED
    tried = torch.searchsorted(known.cumsum(dim=1), rank + 1).clamp(max=known.shape[1] - 1)[..., None]
    axes, places = (torch.take_along_dim(values, tried, dim=1)[:, :, None] for values in (normals, positions))
    # Sums, not matrix products, which may be rounded by more than a pixel's width (float32_matmul_precision).
    heights = ((positions[:, None] - places) * axes).sum(dim=-1)
    is_on = (heights.abs() < sizes[:, None]) & ((normals[:, None] * axes).sum(dim=-1) > _ALIGNED)
    votes = (is_on * areas[:, None]).sum(dim=-1)
    best = votes.argmax(dim=1)[:, None, None]
    is_on = torch.take_along_dim(is_on, best, dim=1).squeeze(1)
    weights = is_on * areas
    share = weights.sum(dim=1) / areas.sum(dim=1).clamp(min=1e-30)
    weights = weights / weights.sum(dim=1, keepdim=True).clamp(min=1e-30)

    def mean(values: Tensor) -> Tensor:
        return (weights[..., None] * values).sum(dim=1)

    normal, center = nn.functional.normalize(mean(normals), dim=-1), mean(positions)
    radii = torch.where(is_on, (positions - center[:, None]).square().sum(dim=-1), 0.0).amax(dim=1).sqrt()
    return Ground(normal, (center * normal).sum(dim=-1), mean(colors), share > _LEAST_SHARE, center, radii)


def _octaves(values: Tensor, count: int) -> Tensor:
    angles = [values * (torch.pi * 2**octave) for octave in range(count)]
    return torch.cat([values, *(wave(angle) for angle in angles for wave in (torch.sin, torch.cos))], dim=-1)


class Background(nn.Sequential):
    """A colour for each direction. Octaves of it, as in NeRF: what lies outside of the workspace has detail, too."""

    def __init__(self, *, frequencies: int, hidden_dim: int):
        super().__init__(nn.Linear(3 + 6 * frequencies, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, 3))
        self.frequencies = frequencies

    def forward(self, directions: Float[Tensor, "batch ray 3"]) -> Float[Tensor, "batch ray 3"]:
        """Return colours in [0, 1]."""
        return torch.sigmoid(super().forward(_octaves(directions, self.frequencies)).to(directions.dtype))


class UnseenGround(nn.Module):
    """What the ground looks like where no input camera saw it: a guess, learned from cameras that did.

    A network of the place where the ray meets the plane (contracted beyond ``length`` metres, as in mip-NeRF 360) and
    of the ray's direction predicts its difference from the mean colour of the ground that was seen. Before training
    that is zero.
    """

    def __init__(self, *, frequencies: int, hidden_dim: int, length: float, near: float):
        super().__init__()
        self.frequencies, self.length, self.near = frequencies, length, near
        self.network = nn.Sequential(
            nn.Linear(6 * (1 + 2 * frequencies), hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, 3, bias=False)
        )
        nn.init.zeros_(self.network[-1].weight)

    def forward(
        self, scenery: Scenery, rays: Rays, beyond: Float[Tensor, "batch ray 3"]
    ) -> tuple[Float[Tensor, "batch ray 3"], Float[Tensor, "batch ray"]]:
        """Return colours in [0, 1], ``beyond`` where a ray meets no ground; and how much of a ray surely meets it.

        It does where it was seen farther out than the ray meets it; it may end there.
        """
        ground = ground_of(scenery)
        normals = ground.normals[:, None]
        facing = (rays.directions * normals).sum(dim=-1)
        above = (rays.origins * normals).sum(dim=-1) - ground.heights[:, None]
        distances = above / -facing.clamp(max=-1e-6)
        meets = ground.found[:, None] & (distances > self.near) & (facing < 0)
        share = torch.where(meets, (-facing / _FADES).clamp(max=1), 0.0)
        met = rays.origins + distances.clamp(min=0)[..., None] * rays.directions
        is_within = (met - ground.centers[:, None]).square().sum(dim=-1) < ground.radii[:, None].square()
        places = met / self.length
        radii = places.square().sum(dim=-1, keepdim=True).clamp(min=1e-20).sqrt()
        places = torch.where(radii > 1, (2 - 1 / radii) / radii, 1.0) * places
        inputs = torch.cat([_octaves(places, self.frequencies), _octaves(rays.directions, self.frequencies)], dim=-1)
        mean = torch.logit(ground.colors.clamp(DARKEST, 1 - DARKEST))[:, None]
        colors = torch.sigmoid(mean + self.network(inputs).to(mean.dtype))
        return share[..., None] * colors + (1 - share[..., None]) * beyond, share * is_within
