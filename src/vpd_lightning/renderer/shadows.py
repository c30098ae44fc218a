"""Shadows of what moves on what stands still: light that bodies keep away, with directions learned from pixels."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vpd_lightning.geometry.decay import decay

_POINTS_PER_CHUNK = 1024
"""Points at a time without gradients: with 128 occluders half a megabyte, which stays in cache."""


class Shadows(nn.Module):
    """How much light reaches a point past the bodies, from ``num_lights`` lights far away.

    A point of a body that lies within about ``softness`` (metres, learned) of the line to a light keeps that light
    away. Each light has a learned direction and a learned share of the light per colour channel. Directions start
    spread over the upper half; pixels decide which of them cast shadows.
    """

    # Paper: has no shadows of its own; the radiance field paints what its particles' features say.

    def __init__(self, *, num_lights: int, softness: float):
        super().__init__()
        if num_lights < 1 or softness <= 0:
            raise ValueError(f"num_lights must be at least 1 and softness positive, got {num_lights} and {softness}")
        self.directions = nn.Parameter(_spread(num_lights))
        # Together a tenth of the light before training.
        self.shares = nn.Parameter(torch.full((num_lights, 3), 0.1 / num_lights))
        self.log_softness = nn.Parameter(torch.full((num_lights,), softness).log())

    def forward(
        self,
        points: Float[Tensor, "batch point 3"],
        occluders: Float[Tensor, "batch occluder 3"],
        mask: Bool[Tensor, "batch occluder"],
    ) -> Float[Tensor, "batch point 3"]:
        """Return the share of light per colour channel that reaches the points, in (0, 1]."""
        if occluders.shape[1] == 0:  # each weight has a gradient all the same, as training on several devices needs
            return torch.ones_like(points) + 0 * sum(weight.sum() for weight in self.parameters())
        if torch.is_grad_enabled() or points.shape[1] <= _POINTS_PER_CHUNK:
            return self._light(points, occluders, mask)
        return torch.cat([self._light(some, occluders, mask) for some in points.split(_POINTS_PER_CHUNK, dim=1)], dim=1)

    def _light(self, points: Tensor, occluders: Tensor, mask: Tensor) -> Float[Tensor, "batch point 3"]:
        light = torch.ones_like(points)
        # Seen from among the occluders, so that squares of coordinates keep their digits.
        count = mask.sum(dim=1).clamp(min=1)[:, None, None]
        center = torch.where(mask[..., None], occluders, 0.0).sum(dim=1, keepdim=True) / count
        points, occluders = points - center, occluders - center
        directions = nn.functional.normalize(self.directions, dim=-1).to(points.dtype)
        there = mask[:, None].to(points.dtype)
        square = points.square().sum(-1, keepdim=True) + occluders.square().sum(-1)[:, None]
        square = torch.baddbmm(square, points, occluders.mT, alpha=-2)
        # Never less than no light; the gradient goes through, so that a light that went out may come back.
        positive = self.shares + (self.shares.clamp(min=0) - self.shares).detach()
        lit = (
            range(len(positive)) if torch.is_grad_enabled() else (positive > 0).any(dim=1).nonzero().flatten().tolist()
        )
        for direction, shares, log_softness in ((directions[i], positive[i], self.log_softness[i]) for i in lit):
            width = log_softness.exp()
            towards = (occluders @ direction)[:, None] - (points @ direction)[..., None]
            beside = (square - towards.square()).clamp(min=0) / (2 * width.square())
            # What touches the point is its own surface; what is below it does not cast.
            ahead = torch.sigmoid(towards / (0.5 * width) - 2.0)
            blocked = (decay(-beside) * ahead * there).sum(dim=-1, keepdim=True)
            light = light - shares * (1 - decay(-blocked))
        return light.clamp(min=0.05)


def _spread(count: int) -> Float[Tensor, "light 3"]:
    """Return directions spread over the upper half, the first straight up (a golden spiral)."""
    steps = torch.arange(count, dtype=torch.float32)
    height = 1 - 0.8 * steps / max(count, 2)
    angle = steps * 2.399963
    radius = (1 - height.square()).clamp(min=0).sqrt()
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), height], dim=-1)
