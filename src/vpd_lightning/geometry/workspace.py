"""Crop points to the workspace and choose a fixed number of them."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def inside_workspace(
    points: Float[Tensor, "*shape 3"], workspace_min: Sequence[float], workspace_max: Sequence[float]
) -> Bool[Tensor, "*shape"]:
    """Mark the points inside the box, bounds included. Non-finite points are outside."""
    low, high = points.new_tensor(list(workspace_min)), points.new_tensor(list(workspace_max))
    return ((points >= low) & (points <= high)).all(dim=-1)


def choose(
    candidates: Bool[Tensor, " point"], count: int, generator: torch.Generator
) -> tuple[Int[Tensor, " particle"], Bool[Tensor, " particle"]]:
    """Choose ``count`` of the candidates uniformly without replacement.

    Returns (index, valid); where there are fewer candidates than wanted, the rest is padding with ``valid`` false.
    The draw is made on the CPU, so that every device chooses the same points.
    """
    index = candidates.nonzero().flatten()
    order = torch.randperm(len(index), generator=generator)[:count].to(index.device)
    chosen = index.new_zeros(count)
    valid = torch.zeros(count, dtype=torch.bool, device=index.device)
    chosen[: len(order)] = index[order]
    valid[: len(order)] = True
    return chosen, valid


def choose_same(
    candidates: Bool[Tensor, " point"], count: int, generator: torch.Generator
) -> tuple[Int[Tensor, " particle"], Bool[Tensor, " particle"]]:
    """As ``choose``, but equal generators choose the same points wherever these are candidates.

    Every point gets a random rank, candidate or not, and the candidates of the lowest ranks are chosen.
    """
    ranks = torch.randperm(len(candidates), generator=generator)
    order = ranks.to(candidates.device).masked_fill(~candidates, len(candidates)).argsort()[:count]
    index = torch.nn.functional.pad(order, (0, count - len(order)))
    valid = torch.arange(count, device=index.device) < candidates.sum()
    return torch.where(valid, index, 0), valid
