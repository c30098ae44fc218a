"""The GPU kernels of ``fused_features_triton``; import this only where Triton is installed.

Tiles are ``[query or reference, kernel, feature]``, all powers of two; what is padded is never read or written.
``table`` holds the neighbours of all queries, -1 for none. ``inverses`` are one over the bandwidths.
"""

from typing import no_type_check

import triton
import triton.language as tl


@triton.jit
@no_type_check
def _weigh(dx, dy, dz, is_there, radii, inverses, KERNELS: tl.constexpr):
    """Return distances, weights and the weights' derivatives by distance, zero where there is no neighbour."""
    m = tl.arange(0, KERNELS)
    radius, inverse = tl.load(radii + m)[None, :], tl.load(inverses + m)[None, :]
    squared = dx * dx + dy * dy + dz * dz
    distance = tl.sqrt(squared)
    offset = (distance[:, None] - radius) * inverse
    weight = tl.where(is_there[:, None], tl.exp(-(offset * offset)), 0.0)
    # Not zero times infinity.
    slope = tl.where(weight == 0.0, 0.0, weight * (-2.0 * offset * inverse))
    return distance, weight, slope


@triton.jit
@no_type_check
def _along(grad, slope, feature, distance):
    """Return the derivative by distance over the distance; zero at distance zero by definition."""
    by_feature = tl.sum(slope[:, :, None] * grad, axis=1)
    by_distance = tl.sum(by_feature * feature, axis=1)
    is_moving = (distance > 0.0) & (by_distance != 0.0)
    return tl.where(is_moving, by_distance / tl.where(is_moving, distance, 1.0), 0.0)


@triton.jit
@no_type_check
def sum_features(
    queries, positions, features, table, radii, inverses, out,
    num_queries, num_particles, num_neighbors,
    NUM_KERNELS: tl.constexpr, WIDTH: tl.constexpr,
    BLOCK: tl.constexpr, KERNELS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Sum over the neighbours of ``BLOCK`` queries of one set; the sums stay in registers."""
    number = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_query = number < num_queries
    # 64 bits: a scene's 2^20 queries of 64 sums in 32 sets pass 2^31.
    query = tl.program_id(1).to(tl.int64) * num_queries + number
    first_particle = tl.program_id(1).to(tl.int64) * num_particles
    m, f = tl.arange(0, KERNELS), tl.arange(0, LANES)
    x = tl.load(queries + query * 3, is_query, 0.0)
    y = tl.load(queries + query * 3 + 1, is_query, 0.0)
    z = tl.load(queries + query * 3 + 2, is_query, 0.0)
    total = tl.zeros([BLOCK, KERNELS, LANES], dtype=out.dtype.element_ty)
    for slot in range(num_neighbors):
        row = tl.load(table + query * num_neighbors + slot, is_query, -1)
        is_there = row >= 0
        place = first_particle + row
        dx = tl.load(positions + place * 3, is_there, 0.0) - x
        dy = tl.load(positions + place * 3 + 1, is_there, 0.0) - y
        dz = tl.load(positions + place * 3 + 2, is_there, 0.0) - z
        distance, weight, slope = _weigh(dx, dy, dz, is_there, radii, inverses, KERNELS)
        is_feature = is_there[:, None] & (f < WIDTH)[None, :]
        feature = tl.load(features + place[:, None] * WIDTH + f[None, :], is_feature, 0.0)
        total += weight[:, :, None] * feature[:, None, :]
    sums = (query[:, None, None] * NUM_KERNELS + m[None, :, None]) * WIDTH + f[None, None, :]
    is_written = is_query[:, None, None] & (m < NUM_KERNELS)[None, :, None] & (f < WIDTH)[None, None, :]
    tl.store(out + sums, total, is_written)


@triton.jit
@no_type_check
def add_gradients(
    queries, positions, features, table, radii, inverses, grad, grad_queries, grad_positions, grad_features,
    num_queries, num_particles, num_neighbors,
    NUM_KERNELS: tl.constexpr, WIDTH: tl.constexpr,
    BLOCK: tl.constexpr, KERNELS: tl.constexpr, LANES: tl.constexpr, SCATTER: tl.constexpr,
):  # fmt: skip
    """Write the gradients of ``BLOCK`` queries and, with ``SCATTER``, add those of particles, in any order."""
    number = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_query = number < num_queries
    query = tl.program_id(1).to(tl.int64) * num_queries + number
    first_particle = tl.program_id(1).to(tl.int64) * num_particles
    m, f = tl.arange(0, KERNELS), tl.arange(0, LANES)
    x = tl.load(queries + query * 3, is_query, 0.0)
    y = tl.load(queries + query * 3 + 1, is_query, 0.0)
    z = tl.load(queries + query * 3 + 2, is_query, 0.0)
    sums = (query[:, None, None] * NUM_KERNELS + m[None, :, None]) * WIDTH + f[None, None, :]
    is_read = is_query[:, None, None] & (m < NUM_KERNELS)[None, :, None] & (f < WIDTH)[None, None, :]
    given = tl.load(grad + sums, is_read, 0.0)
    sum_x = tl.zeros([BLOCK], dtype=grad.dtype.element_ty)
    sum_y = tl.zeros([BLOCK], dtype=grad.dtype.element_ty)
    sum_z = tl.zeros([BLOCK], dtype=grad.dtype.element_ty)
    for slot in range(num_neighbors):
        row = tl.load(table + query * num_neighbors + slot, is_query, -1)
        is_there = row >= 0
        place = first_particle + row
        dx = tl.load(positions + place * 3, is_there, 0.0) - x
        dy = tl.load(positions + place * 3 + 1, is_there, 0.0) - y
        dz = tl.load(positions + place * 3 + 2, is_there, 0.0) - z
        distance, weight, slope = _weigh(dx, dy, dz, is_there, radii, inverses, KERNELS)
        is_feature = is_there[:, None] & (f < WIDTH)[None, :]
        feature = tl.load(features + place[:, None] * WIDTH + f[None, :], is_feature, 0.0)
        factor = _along(given, slope, feature, distance)
        # Masked lanes measure from the origin, which may be infinitely far: select, do not multiply.
        is_moving = is_there & (factor != 0.0)
        dx, dy, dz = tl.where(is_moving, dx, 0.0), tl.where(is_moving, dy, 0.0), tl.where(is_moving, dz, 0.0)
        sum_x -= factor * dx
        sum_y -= factor * dy
        sum_z -= factor * dz
        if SCATTER:
            added = tl.sum(weight[:, :, None] * given, axis=1)
            tl.atomic_add(grad_features + place[:, None] * WIDTH + f[None, :], added, is_feature, sem="relaxed")
            tl.atomic_add(grad_positions + place * 3, factor * dx, is_moving, sem="relaxed")
            tl.atomic_add(grad_positions + place * 3 + 1, factor * dy, is_moving, sem="relaxed")
            tl.atomic_add(grad_positions + place * 3 + 2, factor * dz, is_moving, sem="relaxed")
    tl.store(grad_queries + query * 3, sum_x, is_query)
    tl.store(grad_queries + query * 3 + 1, sum_y, is_query)
    tl.store(grad_queries + query * 3 + 2, sum_z, is_query)


@triton.jit
@no_type_check
def gather_gradients(
    queries, positions, features, radii, inverses, grad, order, starts, grad_positions, grad_features, num_neighbors,
    NUM_KERNELS: tl.constexpr, WIDTH: tl.constexpr,
    BLOCK: tl.constexpr, KERNELS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Sum the gradients of one particle over its references, ``BLOCK`` at a time, in their order.

    ``order`` are references (number of the query times ``num_neighbors``, plus slot) sorted by particle; those of
    particle i are the ones from ``starts[i]`` to ``starts[i + 1]``.
    """
    particle = tl.program_id(0).to(tl.int64)
    m, f, lanes = tl.arange(0, KERNELS), tl.arange(0, LANES), tl.arange(0, BLOCK)
    x = tl.load(positions + particle * 3)
    y = tl.load(positions + particle * 3 + 1)
    z = tl.load(positions + particle * 3 + 2)
    feature = tl.load(features + particle * WIDTH + f, f < WIDTH, 0.0)
    by_feature = tl.zeros([LANES], dtype=grad.dtype.element_ty)
    sum_x = tl.zeros([BLOCK], dtype=grad.dtype.element_ty)
    sum_y = tl.zeros([BLOCK], dtype=grad.dtype.element_ty)
    sum_z = tl.zeros([BLOCK], dtype=grad.dtype.element_ty)
    first, last = tl.load(starts + particle), tl.load(starts + particle + 1)
    for at in range(first, last, BLOCK):
        is_there = at + lanes < last
        query = (tl.load(order + at + lanes, is_there, 0) // num_neighbors).to(tl.int64)
        dx = x - tl.load(queries + query * 3, is_there, 0.0)
        dy = y - tl.load(queries + query * 3 + 1, is_there, 0.0)
        dz = z - tl.load(queries + query * 3 + 2, is_there, 0.0)
        sums = (query[:, None, None] * NUM_KERNELS + m[None, :, None]) * WIDTH + f[None, None, :]
        is_read = is_there[:, None, None] & (m < NUM_KERNELS)[None, :, None] & (f < WIDTH)[None, None, :]
        given = tl.load(grad + sums, is_read, 0.0)
        distance, weight, slope = _weigh(dx, dy, dz, is_there, radii, inverses, KERNELS)
        by_feature += tl.sum(tl.sum(weight[:, :, None] * given, axis=1), axis=0)
        factor = _along(given, slope, feature[None, :], distance)
        is_moving = is_there & (factor != 0.0)
        sum_x += tl.where(is_moving, factor * dx, 0.0)
        sum_y += tl.where(is_moving, factor * dy, 0.0)
        sum_z += tl.where(is_moving, factor * dz, 0.0)
    tl.store(grad_features + particle * WIDTH + f, by_feature, f < WIDTH)
    tl.store(grad_positions + particle * 3, tl.sum(sum_x, axis=0))
    tl.store(grad_positions + particle * 3 + 1, tl.sum(sum_y, axis=0))
    tl.store(grad_positions + particle * 3 + 2, tl.sum(sum_z, axis=0))
