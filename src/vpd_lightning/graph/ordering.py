"""Points in Morton order and cut into blocks with bounding boxes: what lies close together is stored close together."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

_BITS = 20
"""Bits per axis of a Morton code: three of them fit into 63 bits."""


@dataclass(frozen=True)
class PointBlocks:
    """Points sorted along a Morton curve, in consecutive blocks of ``block_size`` (the last block may be shorter).

    ``order[i]`` is the index that sorted point i had before; the boxes bound the points of each block (metres).
    """

    points: Float[Tensor, "point 3"]
    order: Int64[Tensor, " point"]
    box_min: Float[Tensor, "block 3"]
    box_max: Float[Tensor, "block 3"]
    block_size: int


def morton_order(
    points: Float[Tensor, "point 3"], mask: Bool[Tensor, " point"] | None = None
) -> Int64[Tensor, " point"]:
    """Return the indices that sort finite points along a Morton (Z-order) curve through their bounding box.

    Equal codes keep their order. Points outside ``mask`` come last, whatever they hold. Works on any device without
    synchronising with the host.
    """
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.int64, device=points.device)
    if mask is not None:
        points = _replaced(points, mask)
    low, high = points.amin(dim=0), points.amax(dim=0)
    # One scale for all axes keeps cells cubic; halves avoid overflow of the difference of extreme coordinates.
    extent = (high / 2 - low / 2).amax().clamp(min=torch.finfo(points.dtype).tiny)
    cells = ((points / 2 - low / 2) / extent * (2**_BITS - 1)).clamp(0, 2**_BITS - 1).long()
    spread = _spread_bits(cells)
    codes = spread[:, 0] | (spread[:, 1] << 1) | (spread[:, 2] << 2)
    if mask is not None:
        codes = codes.masked_fill(~mask, torch.iinfo(torch.int64).max)
    return codes.argsort(stable=True)


def _replaced(points: Float[Tensor, "point 3"], mask: Bool[Tensor, " point"]) -> Float[Tensor, "point 3"]:
    """Put points outside ``mask`` where they leave the bounding box of the others as it is."""
    low = points.masked_fill(~mask[:, None], torch.inf).amin(dim=0)
    return torch.where(mask[:, None], points, low.masked_fill(low == torch.inf, 0))


def _spread_bits(cells: Int64[Tensor, "point 3"]) -> Int64[Tensor, "point 3"]:
    """Put two zero bits between each two of the lowest 21 bits."""
    for shift, keep in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        cells = (cells | (cells << shift)) & keep
    return cells


def build_blocks(
    points: Float[Tensor, "point 3"], block_size: int, mask: Bool[Tensor, " point"] | None = None
) -> PointBlocks:
    """Sort finite points along a Morton curve and bound every ``block_size`` of them by a box.

    Points outside ``mask`` come last, infinitely far away and in no box: whatever they held, nothing finds them. A
    box of none but such points is (infinity, -infinity).
    """
    order = morton_order(points, mask)
    points = points.index_select(0, order)
    num_blocks = -(-len(points) // block_size)
    if num_blocks == 0:
        return PointBlocks(points, order, points, points, block_size)
    upper = points
    if mask is not None:
        outside = ~mask.index_select(0, order)[:, None]
        points, upper = points.masked_fill(outside, torch.inf), points.masked_fill(outside, -torch.inf)
    box_min = _blocked(points, num_blocks, block_size).amin(dim=1)
    return PointBlocks(points, order, box_min, _blocked(upper, num_blocks, block_size).amax(dim=1), block_size)


def _blocked(points: Float[Tensor, "point 3"], num_blocks: int, block_size: int) -> Float[Tensor, "block in_block 3"]:
    """Cut points into blocks; repeating the last point fills the last block without moving its box."""
    missing = num_blocks * block_size - len(points)
    return torch.cat([points, points[-1:].expand(missing, 3)]).view(num_blocks, block_size, 3)
