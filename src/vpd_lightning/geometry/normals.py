"""Surface normals from a depth image."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.types import Cameras


def depth_normals(
    depth: Float[Tensor, "*shape height width"], cameras: Cameras
) -> Float[Tensor, "*shape height width 3"]:
    """Return unit normals towards the camera; zero where they are undefined (image border, missing depth).

    Each image axis uses whichever one-sided difference crosses the smaller depth step, so that a normal beside an
    occlusion edge belongs to its own surface.
    """
    # A missing neighbour must count as a large step; comparisons with NaN would choose it.
    depth = torch.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0)
    points = unproject(depth, cameras)
    valid = depth > 0

    def tangent(axis: int) -> Tensor:
        """Return the smaller step along an image axis; zero, hence no normal, where both neighbours are missing."""
        ahead, behind = torch.roll(depth, -1, axis), torch.roll(depth, 1, axis)
        forward_step = (ahead - depth).abs().masked_fill(ahead <= 0, torch.inf)
        backward_step = (behind - depth).abs().masked_fill(behind <= 0, torch.inf)
        forward = torch.roll(points, -1, axis - 1) - points  # axis counts without the trailing coordinate axis
        backward = points - torch.roll(points, 1, axis - 1)
        chosen = torch.where((forward_step <= backward_step)[..., None], forward, backward)
        known = torch.isfinite(torch.minimum(forward_step, backward_step))
        return chosen * known[..., None]

    # Unit tangents first: a product of two steps would leave the range of small worlds.
    normals = _unit(torch.linalg.cross(_unit(tangent(-2)), _unit(tangent(-1))))
    center = cameras.cam_to_world[..., :3, 3][..., None, None, :]
    towards = ((center - points) * normals).sum(dim=-1, keepdim=True)
    normals = torch.where(towards < 0, -normals, normals)
    inner = torch.zeros_like(valid)
    inner[..., 1:-1, 1:-1] = True
    return normals * (valid & inner)[..., None]


def _unit(vectors: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape 3"]:
    """Return vectors of length one, and zero where the length is zero."""
    length = vectors.norm(dim=-1, keepdim=True)
    return vectors / torch.where(length > 0, length, 1.0)
