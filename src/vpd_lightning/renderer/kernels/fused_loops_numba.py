"""The compiled loops of ``fused_features_numba``: distances, kernels and sums over neighbours, a few queries at a time.

numba's vectoriser proves neither that the sums stay in registers nor that rows do not overlap, and leaves the two sums
over rows scalar (10 times slower), so these two are written in LLVM's vector instructions: _sum_rows and _add_rows.
Contraction (one rounding for ``a * b + c`` instead of two) is the only liberty that the compiler is given.

All compiled functions are in this file: what numba keeps on disk is not renewed when another file changes.
"""

import math
from typing import no_type_check

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, overload

KERNELS, LANES = 4, 16
"""One pass over the rows serves four kernels and sixteen features; other numbers are padded to multiples."""
_BLOCK_REFERENCES = 512
"""References (query, neighbour) worked on at once: their distances and weights fill 10 KiB of the cache."""

_compiled = numba.njit(nogil=True, cache=True, fastmath={"contract"})


def _exp(x):  # type: ignore[no-untyped-def]
    raise NotImplementedError("compiled only")


@overload(_exp, jit_options={"fastmath": {"contract"}})
@no_type_check
def _compiled_exp(x):
    """``e^x`` for ``x <= 0``: float32 branch-free, so that a loop over it becomes vector instructions.

    ``e^x = 2^n e^r`` with ``|r| <= ln(2)/2`` and the polynomial of Cephes' expf (S. Moshier): within 2 units in the
    last place. Results below the smallest normal number, 1.2e-38, are 0: denormal factors cost a hundred cycles each.
    """
    if x != types.float32:
        return lambda x: math.exp(x)
    lowest, log2_e, shift = np.float32(-87.33654), np.float32(1.44269504088896341), np.float32(12582912.0)
    ln2_high, ln2_low = np.float32(0.693359375), np.float32(-2.12194440e-4)
    p0, p1, p2 = np.float32(1.9875691500e-4), np.float32(1.3981999507e-3), np.float32(8.3334519073e-3)
    p3, p4, p5 = np.float32(4.1665795894e-2), np.float32(1.6666665459e-1), np.float32(5.0000001201e-1)
    zero, one, offset, mantissa = np.float32(0), np.float32(1), np.int32(0x4B400000 - 127), np.int32(23)

    def vectorised(x):
        clamped = lowest if x < lowest else x
        # Adding 1.5 * 2^23 rounds to an integer, which is then the lowest bits of the sum.
        shifted = np.float32(clamped * log2_e + shift)
        n = shifted - shift
        r = (clamped - n * ln2_high) - n * ln2_low
        polynomial = ((((p0 * r + p1) * r + p2) * r + p3) * r + p4) * r + p5
        power = np.int32((np.float32(shifted).view(np.int32) - offset) << mantissa).view(np.float32)
        return zero if x < lowest else ((polynomial * r) * r + r + one) * power

    return vectorised


@no_type_check
def _vector_code(context, builder, signature, args):
    """Return what the two intrinsics below share: their arguments as LLVM values; loads, stores, splats and sums."""
    element = context.get_data_type(signature.args[0].dtype)
    vector, word, lane = ir.VectorType(element, LANES), ir.IntType(64), ir.IntType(32)
    nothing = ir.Constant(vector, ir.Undefined)
    size = 8 if isinstance(element, ir.DoubleType) else 4
    arguments = list(enumerate(zip(signature.args, args, strict=True)))

    class Code:
        zeros = ir.Constant(vector, [0.0] * LANES)
        arrays = {
            number: context.make_array(kind)(context, builder, value).data
            for number, (kind, value) in arguments
            if isinstance(kind, types.Array)
        }
        numbers = {
            number: context.cast(builder, value, kind, types.int64)
            for number, (kind, value) in arguments
            if not isinstance(kind, types.Array)
        }

        def at(self, array, offset, step=None, times=0):
            if step is not None:
                offset = builder.add(offset, builder.mul(step, ir.Constant(word, times)))
            return builder.gep(self.arrays[array], [offset])

        def load(self, address):
            return builder.load(builder.bitcast(address, vector.as_pointer()), align=size)

        def store(self, value, address):
            builder.store(value, builder.bitcast(address, vector.as_pointer()), align=size)

        def row(self, array, number):
            return builder.sext(builder.load(self.at(array, number)), word)

        def splat(self, scalar):
            single = builder.insert_element(nothing, scalar, ir.Constant(lane, 0))
            return builder.shuffle_vector(single, nothing, ir.Constant(ir.VectorType(lane, LANES), [0] * LANES))

        def multiply_add(self, a, b, c):
            return builder.fadd(builder.fmul(a, b, flags=("contract",)), c, flags=("contract",))

        def total(self, value):
            half = LANES // 2
            while half:
                kind = ir.VectorType(lane, half)
                low = builder.shuffle_vector(value, value, ir.Constant(kind, list(range(half))))
                high = builder.shuffle_vector(value, value, ir.Constant(kind, list(range(half, 2 * half))))
                value, half = builder.fadd(low, high), half // 2
            return builder.extract_element(value, ir.Constant(lane, 0))

    return Code()


@intrinsic
@no_type_check
def _sum_rows(typing_context, out, features, weights, rows, at, out_step, column, width, first, count, weight_step):
    """Fill ``out[at + m out_step + lane]`` with the sum over ``n`` of ``weights[first + n + m weight_step] feature``.

    ``feature`` is ``features[rows[first + n] width + column + lane]``; for four kernels ``m``, sixteen lanes, ``n``
    below ``count``. All arrays are flat.
    """

    def generate(context, builder, signature, args):
        code = _vector_code(context, builder, signature, args)
        at, out_step, column, width, first, count, weight_step = (code.numbers[number] for number in range(4, 11))
        # These slots become registers.
        sums = [cgutils.alloca_once(builder, code.zeros.type) for _ in range(KERNELS)]
        for slot in sums:
            builder.store(code.zeros, slot)
        with cgutils.for_range(builder, count) as loop:
            reference = builder.add(first, loop.index)
            feature = code.load(code.at(1, builder.add(builder.mul(code.row(3, reference), width), column)))
            for kernel, slot in enumerate(sums):
                weight = code.splat(builder.load(code.at(2, reference, weight_step, kernel)))
                builder.store(code.multiply_add(weight, feature, builder.load(slot)), slot)
        for kernel, slot in enumerate(sums):
            code.store(builder.load(slot), code.at(0, at, out_step, kernel))
        return context.get_dummy_value()

    arguments = (out, features, weights, rows, at, out_step, column, width, first, count, weight_step)
    return types.void(*arguments), generate


@intrinsic
@no_type_check
def _add_rows(
    typing_context, grad, features, weights, rows, slopes, slope, grad_features, at, grad_step, column, width, first,
    count, weight_step,
):  # fmt: skip
    """Add one query's gradients to its rows of ``grad_features``, and to ``slope``, by the distance of each row.

    ``grad_features[row] += sum_m weights_m grad_m`` and ``slope += (sum_m slopes_m grad_m) . features[row]``, for four
    kernels ``m`` and sixteen features; arrays and steps as in ``_sum_rows``.
    """

    def generate(context, builder, signature, args):
        code = _vector_code(context, builder, signature, args)
        at, grad_step, column, width, first, count, weight_step = (code.numbers[number] for number in range(7, 14))
        grads = [code.load(code.at(0, at, grad_step, kernel)) for kernel in range(KERNELS)]
        with cgutils.for_range(builder, count) as loop:
            reference = builder.add(first, loop.index)
            offset = builder.add(builder.mul(code.row(3, reference), width), column)
            added, along = code.load(code.at(6, offset)), code.zeros
            for kernel, given in enumerate(grads):
                weight = builder.load(code.at(2, reference, weight_step, kernel))
                added = code.multiply_add(code.splat(weight), given, added)
                change = builder.load(code.at(4, reference, weight_step, kernel))
                along = code.multiply_add(code.splat(change), given, along)
            code.store(added, code.at(6, offset))
            product = code.total(builder.fmul(along, code.load(code.at(1, offset))))
            builder.store(builder.fadd(builder.load(code.at(5, reference)), product), code.at(5, reference))
        return context.get_dummy_value()

    arguments = (
        grad, features, weights, rows, slopes, slope, grad_features, at, grad_step, column, width, first, count,
        weight_step,
    )  # fmt: skip
    return types.void(*arguments), generate


@_compiled
@no_type_check
def _pack(index, mask, num_particles, table):
    """Write indices with -1 for masked ones, and return whether all others are those of particles."""
    is_fine = True
    for query in range(index.shape[0]):
        for slot in range(index.shape[1]):
            particle = index[query, slot]
            is_there = (particle >= 0) & (particle < num_particles)
            is_fine &= is_there | (not mask[query, slot])
            table[query, slot] = particle if is_there & mask[query, slot] else -1
    return is_fine


@_compiled
@no_type_check
def _gather(queries, positions, table, first, last, rows, distances, ends):
    """Collect what there is of the neighbours of a few queries, without gaps, and their distances."""
    found = 0
    for query in range(first, last):
        x, y, z = queries[query, 0], queries[query, 1], queries[query, 2]
        for slot in range(table.shape[1]):
            row = table[query, slot]
            # Unsigned, because Python's negative indices cost a comparison each.
            near = np.uint64(max(row, 0))
            dx, dy, dz = positions[near, 0] - x, positions[near, 1] - y, positions[near, 2] - z
            rows[found] = row
            distances[found] = dx * dx + dy * dy + dz * dz
            found += row >= 0
        ends[query - first] = found
    for reference in range(found):
        distances[reference] = np.sqrt(distances[reference])
    return found


@_compiled
@no_type_check
def _weigh(distances, radii, inverses, found, weights):
    for kernel in range(len(radii)):
        radius, inverse = radii[kernel], inverses[kernel]
        of_kernel = weights[kernel]
        for reference in range(found):
            scaled = (distances[reference] - radius) * inverse
            of_kernel[reference] = _exp(-(scaled * scaled))


@_compiled
@no_type_check
def _slopes(distances, radii, inverses, found, weights, slopes):
    """Derivatives of the weights by distance; zero, not zero times infinity, where the weight is zero."""
    for kernel in range(len(radii)):
        radius, inverse = radii[kernel], inverses[kernel]
        factor = inverse * inverse + inverse * inverse
        of_kernel, weight = slopes[kernel], weights[kernel]
        for reference in range(found):
            slope = weight[reference] * ((radius - distances[reference]) * factor)
            of_kernel[reference] = weight[reference] if weight[reference] == 0 else slope


@_compiled
@no_type_check
def sum_features(queries, positions, features, index, mask, table, out, radii, inverses):
    """Fill ``out`` (query, kernel, feature) and ``table``; return whether all indices are those of particles.

    There is at least one particle, the number of kernels is a multiple of ``KERNELS``, that of features of ``LANES``.
    """
    num_queries, k = index.shape
    num_kernels, width = out.shape[1:]
    is_fine = _pack(index, mask, len(positions), table)
    block = max(1, _BLOCK_REFERENCES // max(k, 1))
    # One more than there may be: _gather writes what it then does not count.
    rows, ends = np.empty(block * k + 1, np.int32), np.empty(block, np.int64)
    distances, weights = np.empty(block * k + 1, out.dtype), np.empty((num_kernels, block * k + 1), out.dtype)
    flat_out, flat_features = out.reshape(-1), features.reshape(-1)
    for first in range(0, num_queries, block):
        last = min(first + block, num_queries)
        found = _gather(queries, positions, table, first, last, rows, distances, ends)
        _weigh(distances, radii, inverses, found, weights)
        for kernel in range(0, num_kernels, KERNELS):
            group = weights[kernel : kernel + KERNELS].reshape(-1)
            start = 0
            for query in range(first, last):
                end = ends[query - first]
                at = (query * num_kernels + kernel) * width
                for column in range(0, width, LANES):
                    _sum_rows(
                        flat_out, flat_features, group, rows,
                        at + column, width, column, width, start, end - start, weights.shape[1],
                    )  # fmt: skip
                start = end
    return is_fine


@_compiled
@no_type_check
def add_gradients(
    queries, positions, features, table, grad, grad_queries, grad_positions, grad_features, radii, inverses
):
    """Fill ``grad_queries`` and add to ``grad_positions`` and ``grad_features``, with the weights computed again."""
    num_queries, k = table.shape
    num_kernels, width = grad.shape[1:]
    block = max(1, _BLOCK_REFERENCES // max(k, 1))
    rows, ends = np.empty(block * k + 1, np.int32), np.empty(block, np.int64)
    distances, slope = np.empty(block * k + 1, grad.dtype), np.empty(block * k + 1, grad.dtype)
    weights = np.empty((num_kernels, block * k + 1), grad.dtype)
    slopes = np.empty_like(weights)
    flat_grad, flat_features, flat_sums = grad.reshape(-1), features.reshape(-1), grad_features.reshape(-1)
    for first in range(0, num_queries, block):
        last = min(first + block, num_queries)
        found = _gather(queries, positions, table, first, last, rows, distances, ends)
        _weigh(distances, radii, inverses, found, weights)
        _slopes(distances, radii, inverses, found, weights, slopes)
        slope[:found] = 0
        for kernel in range(0, num_kernels, KERNELS):
            weight_group = weights[kernel : kernel + KERNELS].reshape(-1)
            slope_group = slopes[kernel : kernel + KERNELS].reshape(-1)
            start = 0
            for query in range(first, last):
                end = ends[query - first]
                at = (query * num_kernels + kernel) * width
                for column in range(0, width, LANES):
                    _add_rows(
                        flat_grad, flat_features, weight_group, rows, slope_group, slope, flat_sums,
                        at + column, width, column, width, start, end - start, weights.shape[1],
                    )  # fmt: skip
                start = end
        start = 0
        for query in range(first, last):
            x, y, z = queries[query, 0], queries[query, 1], queries[query, 2]
            sum_x = sum_y = sum_z = x - x
            for reference in range(start, ends[query - first]):
                # The gradient of a distance is zero at zero, and nothing is added for what has no weight at all.
                if distances[reference] > 0 and slope[reference] != 0:
                    near = np.uint64(rows[reference])
                    factor = slope[reference] / distances[reference]
                    dx = factor * (positions[near, 0] - x)
                    dy = factor * (positions[near, 1] - y)
                    dz = factor * (positions[near, 2] - z)
                    grad_positions[near, 0] += dx
                    grad_positions[near, 1] += dy
                    grad_positions[near, 2] += dz
                    sum_x, sum_y, sum_z = sum_x - dx, sum_y - dy, sum_z - dz
            grad_queries[query, 0], grad_queries[query, 1], grad_queries[query, 2] = sum_x, sum_y, sum_z
            start = ends[query - first]
