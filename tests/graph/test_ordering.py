"""Morton order and blocks against their definitions."""

import pytest
import torch

from vpd_lightning.graph.ordering import build_blocks, morton_order


def interleaved(cell: tuple[int, int, int]) -> int:
    return sum(((value >> bit) & 1) << (3 * bit + axis) for axis, value in enumerate(cell) for bit in range(20))


def test_cells_are_sorted_by_interleaved_bits() -> None:
    cells = torch.cartesian_prod(*[torch.arange(8)] * 3)
    shuffled = cells[torch.randperm(len(cells))]
    # The search scales the extent to a grid of 2^20 cells per axis.
    order = morton_order(shuffled.double() * (2**20 - 1) / 7)
    scaled = [tuple(int(v) for v in (row.double() * (2**20 - 1) / 7).tolist()) for row in shuffled[order]]
    codes = [interleaved(cell) for cell in scaled]
    assert codes == sorted(codes)


def test_equal_points_keep_their_order_and_extremes_do_not_overflow() -> None:
    assert morton_order(torch.ones(5, 3)).tolist() == [0, 1, 2, 3, 4]
    assert morton_order(torch.zeros(0, 3)).shape == (0,)
    extreme = torch.tensor([[3e38, 3e38, 3e38], [-3e38, -3e38, -3e38], [0.0, 0, 0]])
    assert morton_order(extreme).tolist() == [1, 2, 0]


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 100])
def test_boxes_bound_their_points_tightly(count: int) -> None:
    points = torch.randn(count, 3)
    blocks = build_blocks(points, 16)
    assert torch.equal(blocks.points, points[blocks.order])
    assert blocks.order.sort().values.tolist() == list(range(count))
    assert len(blocks.box_min) == -(-count // 16)
    for number in range(len(blocks.box_min)):
        members = blocks.points[number * 16 : number * 16 + 16]
        assert torch.equal(blocks.box_min[number], members.amin(dim=0))
        assert torch.equal(blocks.box_max[number], members.amax(dim=0))


@pytest.mark.parametrize("kept", [0, 1, 16, 20, 50])
def test_points_outside_the_mask_come_last_and_are_in_no_box(kept: int) -> None:
    points = torch.randn(50, 3)
    mask = torch.zeros(50, dtype=torch.bool)
    mask[torch.randperm(50)[:kept]] = True
    points[~mask] = torch.nan
    blocks = build_blocks(points, 16, mask)
    inside = build_blocks(points[mask], 16)
    assert bool(mask[blocks.order[:kept]].all()) and not bool(mask[blocks.order[kept:]].any())
    assert torch.equal(blocks.points[:kept], inside.points)
    assert bool((blocks.points[kept:] == torch.inf).all())
    used = len(inside.box_min)
    assert torch.equal(blocks.box_min[:used], inside.box_min) and torch.equal(blocks.box_max[:used], inside.box_max)
    assert bool((blocks.box_min[used:] == torch.inf).all() and (blocks.box_max[used:] == -torch.inf).all())
