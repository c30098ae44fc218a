"""What lies beyond every measured distance, such as the sky: drawn where it was seen, by the direction of a ray."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.finite import is_traced
from vpd_lightning.geometry.decay import decay
from vpd_lightning.renderer.kernels.ray_search import RaySearch
from vpd_lightning.renderer.rays.ray_scores import BesideRay
from vpd_lightning.types import Rays, Scenery

_NUM_CANDIDATES = 4
"""The pixels around a direction."""

_REACH = 1.5
"""Pixel widths beside the nearest pixel up to which a direction counts as seen; that of scenery's points."""

_EDGE = 16.0
"""How sharply that ends, per pixel width."""

_RIM = 0.85
"""Pixel widths by which a far pixel must be nearer to a ray than the scenery is, to be seen in its place. So a floor
ends between its last row of pixels and the first row of sky (1 apart); within a surface no ray is more than 0.71 from
a point."""

_GOES_ON = 16.0
"""Pixel widths over which a sky fades beyond its last pixel: what stands before it covers as much."""


class SeenFar(NamedTuple):
    """What far pixels show along rays; ``nearest`` is the angle to the closest of them, in its pixel's widths."""

    colors: Float[Tensor, "batch ray 3"]
    opacities: Float[Tensor, "batch ray"]
    nearest: Float[Tensor, "batch ray"]

    def leaves(self, nearest: Float[Tensor, "batch ray"]) -> Float[Tensor, "batch ray"]:
        """Return how much of the scenery is seen whose closest point is ``nearest`` away (pixel widths)."""
        return torch.sigmoid(_EDGE * (self.nearest + _RIM - nearest))

    def going_on(self, nearest: Float[Tensor, "batch ray"]) -> Float[Tensor, "batch ray"]:
        """Return how much of a ray that meets nothing that was seen shows their colour: what a body stood before.

        That is where they are nearer to the ray than the scenery, whose closest point is ``nearest`` away (pixel
        widths); farther away less and less.
        """
        share = decay(-0.5 * (self.nearest / _GOES_ON).square())
        return share * torch.sigmoid((nearest - self.nearest).clamp(-50, 50))


def seen_far(scenery: Scenery, rays: Rays, width: Float[Tensor, ""], backend: str) -> SeenFar:
    """Return the mean colour of the far pixels nearest to each ray's direction, under kernels of ``width`` pixels.

    The origin of a ray does not count: what is far away looks the same from everywhere.
    """
    directions = rays.directions
    if not is_traced() and not bool(scenery.far_mask.any()):
        none = torch.zeros_like(directions[..., 0])
        return SeenFar(torch.zeros_like(directions), none, none + 1e6)
    # Points on the unit sphere: how far one lies beside a ray from the middle is the sine of the angle between them.
    search = RaySearch(scenery.views, scenery.far_mask, backend)
    found = search.closest(torch.zeros_like(directions), directions, _NUM_CANDIDATES, BesideRay(0.0, 2.0))
    batch = torch.arange(len(directions), device=directions.device)[:, None, None]
    flat = (batch * scenery.views.shape[1] + found.index).flatten()

    def gather(values: Tensor) -> Tensor:
        return values.flatten(0, 1).index_select(0, flat).unflatten(0, found.index.shape)

    sizes = gather(scenery.sizes)
    spread = (gather(scenery.views) - directions[:, :, None]).square().sum(-1).clamp(min=1e-20).sqrt() / sizes
    logits = (-0.5 * (spread / width).square() - 2 * sizes.log()).masked_fill(~found.mask, -1e30)
    kernels = decay(logits - logits.detach().amax(dim=-1, keepdim=True)) * found.mask
    weights = kernels / kernels.sum(dim=-1, keepdim=True).clamp(min=1e-30)
    colors = (weights[:, :, None] @ gather(scenery.colors)).squeeze(2)
    nearest = spread.masked_fill(~found.mask, 1e6).amin(dim=-1)
    return SeenFar(colors, torch.sigmoid(_EDGE * (_REACH - nearest)), nearest)
