"""What every neighbour search returns, and the parts that all backends share."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.errors import NonFiniteError


@dataclass(frozen=True)
class Neighbors:
    """The nearest points of each query, nearest first, in a fixed table.

    Where ``mask`` is false there is no neighbour: ``index`` is 0 there and ``distance`` (metres) is infinite.
    Nothing in here carries gradients; whoever needs them computes distances again from the positions.
    """

    index: Int64[Tensor, "*batch query neighbor"]
    distance: Float[Tensor, "*batch query neighbor"]
    mask: Bool[Tensor, "*batch query neighbor"]


def require_finite(name: str, positions: Float[Tensor, "any 3"]) -> None:
    """Refuse NaN and infinity before they reach a tree, where they would crash the process or hide.

    Raises:
        NonFiniteError: when a coordinate of ``positions`` is not finite.
    """
    if bool(torch.isfinite(positions).all()):
        return
    bad = int((~torch.isfinite(positions)).any(dim=-1).sum())
    raise NonFiniteError(
        f"Neighbour search: {bad} of {len(positions)} {name} have a coordinate that is NaN or infinite.\n"
        "Either the model diverged, or depth or camera poses are damaged.\n"
        "Lower the learning rate, clip gradients, or check the data with vpd-data validate."
    )


def squared_norm(offset: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape"]:
    """Return x^2 + y^2 + z^2, always summed in this order so that all backends give the same digits."""
    x, y, z = offset.unbind(dim=-1)
    return x * x + y * y + z * z


def no_neighbors(queries: Float[Tensor, "query 3"], k: int) -> Neighbors:
    """Return the table of a search in an empty set of points."""
    shape = (len(queries), k)
    return Neighbors(
        index=torch.zeros(shape, dtype=torch.int64, device=queries.device),
        distance=torch.full(shape, torch.inf, dtype=queries.dtype, device=queries.device),
        mask=torch.zeros(shape, dtype=torch.bool, device=queries.device),
    )


def padded(
    index: Int64[Tensor, "query found"], distance: Float[Tensor, "query found"], k: int, max_radius: float | None
) -> Neighbors:
    """Pad to ``k`` columns and mask what is farther than ``max_radius`` (inclusive) or not there (infinite)."""
    missing = k - index.shape[1]
    if missing:
        index = torch.nn.functional.pad(index, (0, missing))
        distance = torch.nn.functional.pad(distance, (0, missing), value=torch.inf)
    mask = distance < torch.inf
    if max_radius is not None:
        mask &= distance <= max_radius
    return Neighbors(index.masked_fill(~mask, 0), distance.masked_fill(~mask, torch.inf), mask)


def measured(
    points: Float[Tensor, "point 3"],
    queries: Float[Tensor, "query 3"],
    index: Int64[Tensor, "query found"],
    k: int,
    max_radius: float | None,
) -> Neighbors:
    """Measure again, by differences in the precision of ``points``, what a library found (``-1``: nothing found).

    Libraries work in their own precision, so two distances may have swapped places: those rows are sorted again.
    """
    found = index >= 0
    index = index.clamp(min=0)
    offset = points.index_select(0, index.reshape(-1)).view(*index.shape, 3) - queries[:, None]
    distance = squared_norm(offset).sqrt_().masked_fill_(~found, torch.inf)
    swapped = (distance[:, 1:] < distance[:, :-1]).any(dim=1).nonzero()[:, 0]
    if len(swapped):
        distance[swapped], order = distance[swapped].sort(dim=1, stable=True)
        index[swapped] = index[swapped].gather(1, order)
    return padded(index, distance, k, max_radius)
