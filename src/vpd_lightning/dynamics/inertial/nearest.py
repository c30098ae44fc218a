"""The nearest point of another kind for many points at once: what contact asks for in every step."""

import functools
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import vectors_of
from vpd_lightning.threads import in_threads

_PAIRS_PER_TASK = 2_000_000
"""Distances that one thread computes at a time."""


@torch.no_grad()
def nearest_usable(
    queries: Float[Tensor, "batch query 3"],
    points: Float[Tensor, "batch point 3"],
    usable: Bool[Tensor, "batch point"],
    kinds: tuple[Int[Tensor, "batch query"], Int[Tensor, "batch point"]] | None = None,
) -> tuple[Int[Tensor, "batch query"], Bool[Tensor, "batch query"]]:
    """Return the nearest usable point of each query, of equally far ones the first, and whether there is one.

    With ``kinds`` a point of the query's own kind does not count. On a CPU compiled loops compare all pairs; without
    numba, and elsewhere, it is a product of matrices, whose many large results are slow where motions are side by side.
    """
    compiled = _compiled() if queries.device.type == "cpu" else None
    if compiled is None or queries.dtype not in (torch.float32, torch.float64) or points.shape[1] == 0:
        return _by_products(queries, points, usable, kinds)
    index = torch.zeros(queries.shape[:2], dtype=torch.int64)
    exists = torch.zeros(queries.shape[:2], dtype=torch.bool)
    own, other = kinds or (torch.zeros_like(index), torch.zeros_like(usable, dtype=torch.int64))
    parts = [part.contiguous().numpy() for part in (queries, points, usable, own, other)]
    found = index.numpy(), exists.numpy()
    pairs = max(1, queries.shape[1] * points.shape[1])
    size = max(1, _PAIRS_PER_TASK // pairs)
    tasks = [slice(start, start + size) for start in range(0, len(queries), size)]
    in_threads(lambda some: compiled(*(part[some] for part in (*parts, *found)), kinds is not None), tasks)
    return index, exists


def _by_products(
    queries: Tensor, points: Tensor, usable: Tensor, kinds: tuple[Tensor, Tensor] | None
) -> tuple[Tensor, Tensor]:
    """Find them by the product form of the squared distance.

    It takes half the time of differences and finds the two nearest; differences decide between them: two points may be
    equally far, and rounding must not choose.
    """
    counts = usable[:, None] if kinds is None else usable[:, None] & (kinds[0][:, :, None] != kinds[1][:, None])
    origin = queries.mean(dim=1, keepdim=True)
    local, others = queries - origin, points - origin
    order = torch.baddbmm(others.square().sum(dim=-1)[:, None], local, others.mT, alpha=-2)
    lowest, index = order.masked_fill(~counts, torch.inf).topk(min(2, order.shape[-1]), dim=-1, largest=False)
    index = index.sort(dim=-1).values  # of equally far ones the first
    gaps = queries[:, :, None] - vectors_of(points, index.flatten(1)).unflatten(1, index.shape[1:])
    square = gaps.square().sum(dim=-1)
    exists = torch.isfinite(lowest[..., :1])
    chosen = torch.gather(counts.expand(order.shape), 2, index)
    which = square.masked_fill(~chosen, torch.inf).argmin(dim=-1, keepdim=True)
    return torch.gather(index, 2, which).squeeze(-1), exists.squeeze(-1)


@functools.cache
def _compiled() -> Callable[..., None] | None:
    try:
        from vpd_lightning.dynamics.inertial.nearest_numba import nearest
    except ImportError:
        return None
    return nearest  # type: ignore[no-any-return]
