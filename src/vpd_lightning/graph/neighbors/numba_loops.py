"""Compiled loops of the ``numba`` backend: a tree of boxes over Morton-sorted points, searched query after query.

Import this module only where numba is installed.

A query starts with the neighbours of the query before it, measured again: consecutive samples of a ray share nearly all
of them, so the bound on the k-th distance is tight from the start and few boxes are opened. After a jump the leaf under
the new query is read first instead.

Why skipping boxes is exact: a coordinate's distance to a box, ``low - q`` or ``q - high``, is rounded like a point's
``p - q``, and rounding never reverses an order. Summed in the same order, the distance to a box as computed is
therefore never more than that of any point in it as computed, whatever the magnitudes. So no fast-math flag may be set.

Equal distances are ordered by index; thus results depend neither on the order of the queries nor on how they are cut
into slices.

Shapes: ``leaves`` [leaf, 3, LEAF] are coordinates and ``members`` [leaf, LEAF] the points' indices, padded with
infinity and 0. ``boxes[group, :, child]`` is (low x, high x, low y, high y, low z, high z), padded with infinity; the
groups of all levels follow each other, leaves' boxes first, and level l begins at ``first_group[l]``.
"""

from typing import no_type_check

import numba
import numpy as np

LEAF = 32
"""Points per leaf: four vectors of eight float32; 16 and 64 were slower (16,384 points, k = 16)."""

FAN_OUT = 16
"""Boxes per group; 8 was slower."""

_WAITING = FAN_OUT * 34
"""Room on the stack: at most FAN_OUT boxes wait per level, and 34 levels hold any set of points."""

_compiled = numba.njit(nogil=True, cache=True)
# Below, @no_type_check keeps the type checker of the tests from wrapping what numba compiles.


@_compiled
@no_type_check
def _insert(distances, indices, found, distance, index):
    """Insert into the sorted list, pushing out the last when it is full; return the new length."""
    k = len(distances)
    at = found if found < k else k - 1
    while at > 0 and (distances[at - 1] > distance or (distances[at - 1] == distance and indices[at - 1] > index)):
        distances[at] = distances[at - 1]
        indices[at] = indices[at - 1]
        at -= 1
    distances[at] = distance
    indices[at] = index
    return min(found + 1, k)


@_compiled
@no_type_check
def _box_distances(group, x, y, z, bounds):
    """Fill ``bounds`` with the squared distances to a group's boxes (no branches: the compiler vectorises it)."""
    low_x, high_x, low_y, high_y, low_z, high_z = group[0], group[1], group[2], group[3], group[4], group[5]
    zero = x - x
    for i in range(FAN_OUT):
        dx = max(max(low_x[i] - x, x - high_x[i]), zero)
        dy = max(max(low_y[i] - y, y - high_y[i]), zero)
        dz = max(max(low_z[i] - z, z - high_z[i]), zero)
        bounds[i] = dx * dx + dy * dy + dz * dz


@_compiled
@no_type_check
def _nearest_leaf(boxes, first_group, x, y, z, bounds):
    """Walk down to the leaf whose boxes are nearest on every level."""
    node = 0
    for level in range(len(first_group) - 1, -1, -1):
        _box_distances(boxes[first_group[level] + node], x, y, z, bounds)
        nearest = 0
        for i in range(1, FAN_OUT):
            if bounds[i] < bounds[nearest]:
                nearest = i
        node = node * FAN_OUT + nearest
    return node


@_compiled
@no_type_check
def knn_slice(leaves, members, places, boxes, first_group, queries, limit, sure, start, stop, table, index, mask):
    """Fill rows ``start`` to ``stop`` of the table with the nearest points whose squared distance is at most ``limit``.

    Returns whether any of these distances is more than ``sure``, so that the caller must look at it more closely, and
    whether any row has fewer than k points. (Where there is none 1 is written: roots of infinity are slow.)

    Inputs and outputs:
        leaves, members, boxes, first_group: the tree; see the module's docstring.
        places: [point] where each point lies, as leaf * LEAF + column.
        queries: [query, 3] of the same float type.
        limit, sure: largest squared distances allowed, and allowed without doubt; finite.
        start, stop: rows to fill.
        table, index, mask: [query, k] written here: squared distances, int64, bool.
    """
    k = table.shape[1]
    kept, kept_index = np.empty(k, leaves.dtype), np.empty(k, np.int64)
    squared, bounds = np.empty(LEAF, leaves.dtype), np.empty(FAN_OUT, leaves.dtype)
    # The last query that has seen a point, so that none enters the list twice.
    seen = np.full((leaves.shape[0], LEAF), -1, np.int32)
    waiting_level, waiting_node = np.empty(_WAITING, np.int64), np.empty(_WAITING, np.int64)
    waiting_bound = np.empty(_WAITING, leaves.dtype)
    infinity, one = leaves.dtype.type(np.inf), leaves.dtype.type(1)
    found, worst = 0, limit
    last_x = last_y = last_z = infinity
    is_doubtful = is_short = False
    for query in range(start, stop):
        x, y, z = queries[query, 0], queries[query, 1], queries[query, 2]
        turn = np.int32(query - start)
        jump_x, jump_y, jump_z = x - last_x, y - last_y, z - last_z
        jumped = jump_x * jump_x + jump_y * jump_y + jump_z * jump_z > worst
        last_x, last_y, last_z = x, y, z
        # The last query's neighbours, measured again.
        remembered, found = found, 0
        for i in range(remembered):
            place = places[kept_index[i]]
            leaf, column = place // LEAF, place % LEAF
            seen[leaf, column] = turn
            dx, dy, dz = leaves[leaf, 0, column] - x, leaves[leaf, 1, column] - y, leaves[leaf, 2, column] - z
            value = dx * dx + dy * dy + dz * dz
            if value <= limit:
                found = _insert(kept, kept_index, found, value, kept_index[i])
        worst = kept[k - 1] if found == k else limit
        waiting = 1
        waiting_level[0], waiting_node[0], waiting_bound[0] = len(first_group), 0, x - x
        if jumped:
            leaf = _nearest_leaf(boxes, first_group, x, y, z, bounds)
            waiting_level[1], waiting_node[1], waiting_bound[1] = 0, leaf, x - x
            waiting = 2
        while waiting > 0:
            waiting -= 1
            # Equal is not enough to skip: a lower index may wait there.
            if waiting_bound[waiting] > worst:
                continue
            node, level = waiting_node[waiting], waiting_level[waiting]
            if level > 0:
                _box_distances(boxes[first_group[level - 1] + node], x, y, z, bounds)
                for i in range(FAN_OUT):
                    if bounds[i] <= worst:
                        waiting_level[waiting] = level - 1
                        waiting_node[waiting] = node * FAN_OUT + i
                        waiting_bound[waiting] = bounds[i]
                        waiting += 1
                continue
            leaf_x, leaf_y, leaf_z, turns = leaves[node, 0], leaves[node, 1], leaves[node, 2], seen[node]
            for i in range(LEAF):
                dx, dy, dz = leaf_x[i] - x, leaf_y[i] - y, leaf_z[i] - z
                value = dx * dx + dy * dy + dz * dz
                squared[i] = infinity if turns[i] == turn else value
            any_close = False
            for i in range(LEAF):
                any_close |= squared[i] <= worst
            if not any_close:
                continue
            for i in range(LEAF):
                if squared[i] <= worst:
                    point = members[node, i]
                    if found < k or squared[i] < worst or point < kept_index[k - 1]:
                        turns[i] = turn
                        found = _insert(kept, kept_index, found, squared[i], point)
                        if found == k:
                            worst = kept[k - 1]
        is_doubtful |= found > 0 and kept[found - 1] > sure
        is_short |= found < k
        for i in range(k):
            is_found = i < found
            table[query, i] = kept[i] if is_found else one
            index[query, i] = kept_index[i] if is_found else 0
            mask[query, i] = is_found
    return is_doubtful, is_short


@_compiled
@no_type_check
def radius_slice(leaves, members, boxes, first_group, queries, limit, start, stop, ends, senders, is_counting):
    """Count, or write, the points whose squared distance to a query is at most ``limit``.

    Inputs and outputs:
        leaves, members, boxes, first_group, queries, limit, start, stop: as for ``knn_slice``.
        ends: [query]; when counting, the number of points of each query is written here, else it holds where each
            query's part of ``senders`` ends.
        senders: [edge] written when not counting, ascending for each query.
        is_counting: which of the two to do.
    """
    bounds = np.empty(FAN_OUT, leaves.dtype)
    waiting_level, waiting_node = np.empty(_WAITING, np.int64), np.empty(_WAITING, np.int64)
    for query in range(start, stop):
        x, y, z = queries[query, 0], queries[query, 1], queries[query, 2]
        first = 0 if query == 0 or is_counting else ends[query - 1]
        found = 0
        waiting = 1
        waiting_level[0], waiting_node[0] = len(first_group), 0
        while waiting > 0:
            waiting -= 1
            node, level = waiting_node[waiting], waiting_level[waiting]
            if level > 0:
                _box_distances(boxes[first_group[level - 1] + node], x, y, z, bounds)
                for i in range(FAN_OUT):
                    if bounds[i] <= limit:
                        waiting_level[waiting] = level - 1
                        waiting_node[waiting] = node * FAN_OUT + i
                        waiting += 1
                continue
            leaf_x, leaf_y, leaf_z = leaves[node, 0], leaves[node, 1], leaves[node, 2]
            for i in range(LEAF):
                dx, dy, dz = leaf_x[i] - x, leaf_y[i] - y, leaf_z[i] - z
                if dx * dx + dy * dy + dz * dz <= limit:
                    if not is_counting:
                        senders[first + found] = members[node, i]
                    found += 1
        if is_counting:
            ends[query] = found
        else:
            senders[first : first + found].sort()
