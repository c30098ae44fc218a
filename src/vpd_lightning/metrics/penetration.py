"""How deep points lie in what is solid. World frame, metres; 0 where they are outside."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.geometry.rotations import rotation_matrix


def below_floor(points: Float[Tensor, "*shape particle 3"], height: float) -> Float[Tensor, "*shape particle"]:
    """Depth of each point below a level floor at ``height`` (z is up)."""
    return (height - points[..., 2]).clamp(min=0.0)


def inside_box_depth(
    points: Float[Tensor, "step particle 3"], poses: Float[Tensor, "step 7"], half_size: Float[Tensor, " 3"]
) -> Float[Tensor, "step particle"]:
    """Depth of each point in an oriented box that moves: its distance to the nearest face."""
    local = (points - poses[:, None, :3]) @ rotation_matrix(poses[:, 3:])
    return (half_size - local.abs()).amin(-1).clamp(min=0.0)


def deepest(depths: Float[Tensor, "*shape particle"]) -> Float[Tensor, "*shape"]:
    """Depth of the deepest of some points; 0 for none."""
    if depths.shape[-1] == 0:
        return depths.new_zeros(depths.shape[:-1])
    return torch.amax(depths, -1)
