"""Annular kernel features (paper equations 2 and 3), one kernel, neighbour and channel at a time in float64."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def nearest(points: Array, query: Array, count: int) -> list[int]:
    """Indices of the ``count`` points nearest to ``query``, nearest first, ties by index; fewer if there are fewer."""
    distances = [(math.dist(point, query), number) for number, point in enumerate(points)]
    return [number for _, number in sorted(distances)[:count]]


def annular_features(
    queries: Array,
    positions: Array,
    features: Array,
    neighbor_index: NDArray[np.int64],
    neighbor_mask: NDArray[np.bool_],
    kernel_radii: list[float],
    kernel_bandwidths: list[float],
) -> Array:
    """``f(x) = concat_k sum_i exp(-((|x_i - x| - r_k)^2) / b_k^2) z_i`` for every query; (query, kernel * feature)."""
    num_features = features.shape[1]
    result = np.zeros((len(queries), len(kernel_radii) * num_features))
    for number, query in enumerate(queries):
        for kernel, (radius, bandwidth) in enumerate(zip(kernel_radii, kernel_bandwidths, strict=True)):
            for slot in range(neighbor_index.shape[1]):
                if not neighbor_mask[number, slot]:
                    continue
                particle = int(neighbor_index[number, slot])
                distance = math.sqrt(sum((float(positions[particle, a]) - float(query[a])) ** 2 for a in range(3)))
                weight = math.exp(-((distance - radius) ** 2) / bandwidth**2)
                for channel in range(num_features):
                    result[number, kernel * num_features + channel] += weight * float(features[particle, channel])
    return result
