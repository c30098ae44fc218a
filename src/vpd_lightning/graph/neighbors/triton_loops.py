"""The GPU kernel of the ``triton`` backend; import it only where Triton is installed.

One program serves BLOCK_Q consecutive queries. It looks first into the block of points nearest to its first query, so
that the bounds are tight early, then into every other block that is not farther from all its queries than what they
have. Large groups of blocks are skipped at once by a box around the group.

The kernel must run without fused multiply-adds (``enable_fp_fusion=False``): only then is a distance to a box, as
computed, never more than that of a point in it, and only then do distances equal the other backends' to the last bit.

@no_type_check keeps the type checker of the tests from wrapping what Triton compiles.
"""

from typing import no_type_check

import triton
import triton.language as tl


@triton.jit
@no_type_check
def _box_distance(boxes, box, num_boxes, x, y, z):
    """Return the squared distance to a box; ``boxes`` [6, box] holds low x, y, z, then high x, y, z."""
    low_x, high_x = tl.load(boxes + box), tl.load(boxes + 3 * num_boxes + box)
    low_y, high_y = tl.load(boxes + num_boxes + box), tl.load(boxes + 4 * num_boxes + box)
    low_z, high_z = tl.load(boxes + 2 * num_boxes + box), tl.load(boxes + 5 * num_boxes + box)
    dx = tl.maximum(tl.maximum(low_x - x, x - high_x), 0.0)
    dy = tl.maximum(tl.maximum(low_y - y, y - high_y), 0.0)
    dz = tl.maximum(tl.maximum(low_z - z, z - high_z), 0.0)
    return dx * dx + dy * dy + dz * dz


@triton.jit
@no_type_check
def _take_block(points, num_places, block, x, y, z, best, place, worst, limit, BLOCK_P: tl.constexpr, K: tl.constexpr):
    """Replace the worst of each query's list by a nearer point of the block for as long as any list improves."""
    columns = tl.arange(0, BLOCK_P)
    slots = tl.arange(0, K)
    places = block * BLOCK_P + columns
    dx = tl.load(points + places)[None, :] - x[:, None]
    dy = tl.load(points + num_places + places)[None, :] - y[:, None]
    dz = tl.load(points + 2 * num_places + places)[None, :] - z[:, None]
    squared = dx * dx + dy * dy + dz * dz
    nearest = tl.min(squared, axis=1)
    improves = nearest < worst
    while tl.max(improves.to(tl.int32), axis=0) > 0:
        column = tl.argmin(squared, axis=1)
        is_taken = (columns[None, :] == column[:, None]) & improves[:, None]
        is_replaced = (slots[None, :] == tl.argmax(best, axis=1)[:, None]) & improves[:, None]
        best = tl.where(is_replaced, nearest[:, None], best)
        place = tl.where(is_replaced, (block * BLOCK_P + column)[:, None], place)
        worst = tl.minimum(tl.max(best, axis=1), limit)
        squared = tl.where(is_taken, float("inf"), squared)
        nearest = tl.min(squared, axis=1)
        improves = nearest < worst
    return best, place, worst


@triton.jit
@no_type_check
def knn_kernel(
    points,
    blocks,
    groups,
    queries,
    table,
    table_place,
    limit_pointer,
    num_queries,
    num_blocks,
    num_groups,
    k,
    BLOCK_Q: tl.constexpr,
    BLOCK_P: tl.constexpr,
    GROUP: tl.constexpr,
    K: tl.constexpr,
):
    """Fill [query, k] tables with squared distances, nearest first (infinite: none), and places among sorted points.

    Inputs and outputs:
        points: [3, block * BLOCK_P] coordinates in Morton order; what must not be found is infinite.
        blocks, groups: [6, block] and [6, group] boxes; ``num_blocks`` is ``num_groups * GROUP``.
        queries: [query, 3].
        table, table_place: [query, k], written here; the place (int32) is -1 where there is no point.
        limit_pointer: one number; squared distances must be below it.
        num_queries, num_blocks, num_groups, k: sizes.
        BLOCK_Q, BLOCK_P, GROUP: queries per program, points per block, blocks per group.
        K: a power of two, at least ``k``.
    """
    rows = tl.program_id(0).to(tl.int64) * BLOCK_Q + tl.arange(0, BLOCK_Q)
    is_row = rows < num_queries
    # Rows beyond the end repeat the first query; nothing is stored for them.
    source = tl.where(is_row, rows, tl.program_id(0).to(tl.int64) * BLOCK_Q) * 3
    x, y, z = tl.load(queries + source), tl.load(queries + source + 1), tl.load(queries + source + 2)
    limit = tl.load(limit_pointer)
    num_places = num_blocks * BLOCK_P
    slots = tl.arange(0, K)
    # Slots beyond k hold minus infinity: they are never the worst.
    empty = tl.where(slots < k, float("inf"), float("-inf")).to(x.dtype)
    best = tl.zeros((BLOCK_Q, K), x.dtype) + empty[None, :]
    place = tl.full((BLOCK_Q, K), -1, tl.int32)
    worst = tl.zeros((BLOCK_Q,), x.dtype) + limit

    first = tl.program_id(0).to(tl.int64) * BLOCK_Q * 3
    first_x, first_y, first_z = tl.load(queries + first), tl.load(queries + first + 1), tl.load(queries + first + 2)
    seed = 0
    seed_distance = limit
    members = tl.arange(0, GROUP)
    for group in range(num_groups):
        away = _box_distance(blocks, group * GROUP + members, num_blocks, first_x, first_y, first_z)
        nearest = tl.min(away, axis=0)
        seed = tl.where(nearest < seed_distance, group * GROUP + tl.argmin(away, axis=0), seed)
        seed_distance = tl.minimum(nearest, seed_distance)
    best, place, worst = _take_block(points, num_places, seed, x, y, z, best, place, worst, limit, BLOCK_P, K)

    for group in range(num_groups):
        away = _box_distance(groups, group, num_groups, x, y, z)
        if tl.max((away < worst).to(tl.int32), axis=0) > 0:
            for block in range(group * GROUP, group * GROUP + GROUP):
                away = _box_distance(blocks, block, num_blocks, x, y, z)
                is_near = tl.max((away < worst).to(tl.int32), axis=0) > 0
                if is_near & (block != seed):
                    best, place, worst = _take_block(
                        points, num_places, block, x, y, z, best, place, worst, limit, BLOCK_P, K
                    )

    best = tl.where(slots[None, :] < k, best, float("inf"))
    for column in range(k):
        nearest = tl.min(best, axis=1)
        slot = tl.argmin(best, axis=1)
        is_slot = slots[None, :] == slot[:, None]
        found = tl.max(tl.where(is_slot, place, -1), axis=1)
        tl.store(table + rows * k + column, nearest, mask=is_row)
        tl.store(table_place + rows * k + column, found, mask=is_row)
        best = tl.where(is_slot, float("inf"), best)
        place = tl.where(is_slot, -1, place)
