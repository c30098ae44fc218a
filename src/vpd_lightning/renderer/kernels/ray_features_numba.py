"""Annular features of the samples of a ray, compiled: distances, choice, kernels and sums of one sample at a time.

The twin of the plain sums in ``ray_candidates``, for float32 on a CPU. Nothing but the result is stored, and the
backward pass computes weights again, so that training keeps no ``[ray, sample, candidate, kernel]`` either.
"""

from typing import Any, no_type_check

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from vpd_lightning.threads import in_threads

_NUM_SLICES = 8
"""Rays are cut into this many runs, whatever the number of threads; no sum crosses them."""


class RayFeatures(torch.autograd.Function):
    """``(along, across, features, mask, t, num_neighbors, radii, bandwidths)`` to ``ray sample kernel_feature``.

    Leading axes are one: ``ray candidate [feature]`` and ``ray sample``, all float32. ``t`` gets no gradient.
    """

    @staticmethod
    def forward(
        ctx: Any, along: Tensor, across: Tensor, features: Tensor, mask: Tensor, t: Tensor, *rest: Any
    ) -> Tensor:
        """Sum features under kernels; keeps its inputs only."""
        tensors = [tensor.contiguous() for tensor in (along, across, features, mask, t)]
        num_neighbors, radii, bandwidths = rest
        kernels = np.asarray(radii, np.float32), 1 / np.asarray(bandwidths, np.float32)
        result = torch.empty(*t.shape, len(kernels[0]) * features.shape[-1])
        _in_slices(_forward, tensors, num_neighbors, kernels, [result])
        ctx.save_for_backward(*tensors)
        ctx.rest = num_neighbors, kernels
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Compute the weights again and send the gradient to ``along``, ``across`` and ``features``."""
        tensors = ctx.saved_tensors
        results = [torch.zeros_like(tensor) for tensor in tensors[:3]]
        num_neighbors, kernels = ctx.rest
        _in_slices(_backward, tensors, num_neighbors, kernels, [gradients[0].contiguous(), *results])
        return (*results, None, None, None, None, None)


def _in_slices(kernel: Any, tensors: Any, num_neighbors: int, kernels: Any, more: list[Tensor]) -> None:
    arrays = [tensor.detach().numpy() for tensor in tensors]
    results = [tensor.detach().numpy() for tensor in more]
    num_rays = len(arrays[0])
    bounds = [num_rays * part // _NUM_SLICES for part in range(_NUM_SLICES + 1)]

    def run(part: int) -> None:
        kernel(bounds[part], bounds[part + 1], *arrays, num_neighbors, *kernels, *results)

    in_threads(run, range(_NUM_SLICES))


_HALF, _ONE, _TWO_23, _BIAS = (np.float32(value) for value in (0.5, 1.0, 2.0**23, 127.0))
_LOG2_E = np.float32(np.log2(np.e))
# Minimax polynomial of 2^f for |f| <= 1/2 (Cephes, exp2f): relative error 2e-8, below float32's.
_P1, _P2, _P3 = np.float32(0.6931472028550421), np.float32(0.2402264791363012), np.float32(0.05550332471162809)
_P4, _P5, _P6 = np.float32(0.009618437357674640), np.float32(0.001339887440266574), np.float32(0.00015353361883195)

_LANES = 4
"""Neighbours that are summed at a time; a list is filled up to a multiple with infinitely distant ones."""

# Sums may be reordered and contracted: vector instructions need both. Every ray is summed in the same order each time.
_FAST = {"reassoc", "contract", "nsz"}


@numba.njit(nogil=True, cache=True, fastmath=_FAST)
@no_type_check  # numba compiles the bare function, not one wrapped by a type checker
def _choose(along, across, mask, t, num_neighbors, squared, names, distances):
    """List the nearest candidates of a sample: those with fewer than ``num_neighbors`` others nearer."""
    count = mask.shape[0]
    for c in range(count):
        behind = t - along[c]
        squared[c] = across[c] * across[c] + behind * behind if mask[c] else np.float32(np.inf)
    found = 0
    for c in range(count):
        nearer = np.int32(0)
        for other in range(count):
            nearer += np.int32(squared[other] < squared[c])
        names[found] = c
        distances[found] = squared[c]
        found += mask[c] and nearer < num_neighbors
    filled = -(-found // _LANES) * _LANES
    for place in range(filled):
        distances[place] = np.sqrt(distances[place])
    for place in range(found, filled):
        names[place], distances[place] = 0, np.inf
    return found, filled


@numba.njit(nogil=True, cache=True, fastmath=_FAST)
@no_type_check  # numba compiles the bare function, not one wrapped by a type checker
def _weigh(distances, filled, radius, inverse_bandwidth, weights, powers, bits):
    """Write ``exp(-((distance - radius) / bandwidth)^2)`` into ``weights``; below 2^-126 it is 0."""
    for place in range(filled):
        scaled = (distances[place] - radius) * inverse_bandwidth
        exponent = -(scaled * scaled) * _LOG2_E
        exponent = exponent if exponent > -_BIAS else -_BIAS
        whole = np.floor(exponent + _HALF)
        f = exponent - whole
        weights[place] = _ONE + f * (_P1 + f * (_P2 + f * (_P3 + f * (_P4 + f * (_P5 + f * _P6)))))
        bits[place] = np.int32((whole + _BIAS) * _TWO_23)  # the float 2^whole
    for place in range(filled):
        weights[place] *= powers[place]


@numba.njit(nogil=True, cache=True, fastmath=_FAST)
@no_type_check  # numba compiles the bare function, not one wrapped by a type checker
def _forward(begin, end, along, across, features, mask, t, num_neighbors, radii, inverse_bandwidths, result):
    count, width = features.shape[1:]
    room = count + _LANES
    squared, names, distances = np.empty(count, np.float32), np.empty(room, np.int64), np.empty(room, np.float32)
    weights, bits = np.empty(room, np.float32), np.empty(room, np.int32)
    powers = bits.view(np.float32)
    for ray in range(begin, end):
        seen = features[ray]
        for sample in range(t.shape[1]):
            _, filled = _choose(
                along[ray], across[ray], mask[ray], t[ray, sample], num_neighbors, squared, names, distances
            )
            for kernel in range(radii.shape[0]):
                _weigh(distances, filled, radii[kernel], inverse_bandwidths[kernel], weights, powers, bits)
                row = result[ray, sample, kernel * width : (kernel + 1) * width]
                row[:] = 0
                for p in range(0, filled, _LANES):
                    a, b, c, d = seen[names[p]], seen[names[p + 1]], seen[names[p + 2]], seen[names[p + 3]]
                    wa, wb, wc, wd = weights[p], weights[p + 1], weights[p + 2], weights[p + 3]
                    for i in range(width):
                        row[i] += wa * a[i] + wb * b[i] + wc * c[i] + wd * d[i]


@numba.njit(nogil=True, cache=True, fastmath=_FAST)
@no_type_check  # numba compiles the bare function, not one wrapped by a type checker
def _backward(
    begin, end, along, across, features, mask, t, num_neighbors, radii, inverse_bandwidths,
    gradient, to_along, to_across, to_features,
):  # fmt: skip
    count, width = features.shape[1:]
    room = count + _LANES
    squared, names, distances = np.empty(count, np.float32), np.empty(room, np.int64), np.empty(room, np.float32)
    weights, bits = np.empty(room, np.float32), np.empty(room, np.int32)
    powers, to_distances = bits.view(np.float32), np.empty(room, np.float32)
    for ray in range(begin, end):
        for sample in range(t.shape[1]):
            found, filled = _choose(
                along[ray], across[ray], mask[ray], t[ray, sample], num_neighbors, squared, names, distances
            )
            to_distances[:found] = 0
            for kernel in range(radii.shape[0]):
                radius, inverse = radii[kernel], inverse_bandwidths[kernel]
                _weigh(distances, filled, radius, inverse, weights, powers, bits)
                row = gradient[ray, sample, kernel * width : (kernel + 1) * width]
                for place in range(found):
                    seen, to_seen = features[ray, names[place]], to_features[ray, names[place]]
                    weight, to_weight = weights[place], np.float32(0)
                    for i in range(width):
                        to_weight += row[i] * seen[i]
                        to_seen[i] += weight * row[i]
                    scaled = (distances[place] - radius) * inverse
                    to_distances[place] -= to_weight * weight * (scaled + scaled) * inverse
            for place in range(found):
                if distances[place] > 0:
                    c = names[place]
                    to_squared = to_distances[place] / distances[place]
                    to_across[ray, c] += to_squared * across[ray, c]
                    to_along[ray, c] -= to_squared * (t[ray, sample] - along[ray, c])
