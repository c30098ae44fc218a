"""Scenery: a point for every pixel that stands still, for the renderer."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.types import Occluders, RGBDFrames, Scenery


@torch.no_grad()
def scenery_of(
    frames: RGBDFrames,
    points: Float[Tensor, "batch point 3"],
    normals: Float[Tensor, "batch point 3"],
    still: Bool[Tensor, "batch point"],
    occluders: Occluders,
) -> Scenery:
    """Return the pixels that stand still (``point`` counts over ``view height width``; metres, world)."""
    cameras, depth = frames.cameras, frames.depth
    centers = cameras.cam_to_world[..., None, None, :3, 3].expand(*depth.shape, 3).flatten(1, 3)
    focal = (cameras.intrinsics[..., 0, 0] * cameras.intrinsics[..., 1, 1]).sqrt()
    sizes = (depth / focal[..., None, None]).flatten(1)
    points, sizes = torch.where(still[..., None], points, 0.0), torch.where(still, sizes, 1.0)
    away = points - centers
    return Scenery(
        positions=points,
        colors=frames.rgb.flatten(1, 3),
        normals=normals,
        views=away / away.norm(dim=-1, keepdim=True).clamp(min=1e-12),
        sizes=sizes,
        mask=still,
        occluders=occluders.positions,
        occluder_mask=occluders.mask,
    )
