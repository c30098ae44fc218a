"""Scenery: a point for every pixel that stands still, and a direction for those too far to measure."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.types import Occluders, RGBDFrames, Scenery


@torch.no_grad()
def scenery_of(
    frames: RGBDFrames,
    points: Float[Tensor, "batch point 3"],
    normals: Float[Tensor, "batch point 3"],
    still: Bool[Tensor, "batch point"],
    far: Bool[Tensor, "batch point"],
    occluders: Occluders,
) -> Scenery:
    """Return the pixels that stand still (``point`` counts over ``view height width``; metres, world).

    ``far`` are those that measured no distance; none of them is ``still``.
    """
    cameras, depth = frames.cameras, frames.depth
    centers = cameras.cam_to_world[..., None, None, :3, 3].expand(*depth.shape, 3).flatten(1, 3)
    focal = (cameras.intrinsics[..., 0, 0] * cameras.intrinsics[..., 1, 1]).sqrt()
    sizes = (depth / focal[..., None, None]).flatten(1)
    points = torch.where(still[..., None], points, 0.0)
    at_a_metre = (1 / focal[..., None, None]).expand(depth.shape).flatten(1)
    sizes = torch.where(still, sizes, torch.where(far, at_a_metre, 1.0))
    beyond = unproject(torch.ones_like(depth), cameras).flatten(1, 3)
    away = torch.where(far[..., None], beyond, points) - centers
    return Scenery(
        positions=points,
        colors=frames.rgb.flatten(1, 3),
        normals=normals,
        views=away / away.norm(dim=-1, keepdim=True).clamp(min=1e-12),
        sizes=sizes,
        mask=still,
        far_mask=far,
        occluders=occluders.positions,
        occluder_mask=occluders.mask,
    )
