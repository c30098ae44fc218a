"""NeRF's quadrature (Mildenhall et al. 2020, equation 3), one ray and sample at a time in float64."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def composite(sigmas: Array, rgbs: Array, t_starts: Array, t_ends: Array) -> tuple[Array, Array, Array]:
    """Colour (ray 3), weights (ray sample) and what is left behind the last sample (ray).

    ``weight_i = T_i (1 - exp(-sigma_i delta_i))`` with ``T_i = exp(-sum_{j<i} sigma_j delta_j)``.
    """
    num_rays, num_samples = sigmas.shape
    colors, weights, left_over = np.zeros((num_rays, 3)), np.zeros((num_rays, num_samples)), np.zeros(num_rays)
    for ray in range(num_rays):
        optical_depth = 0.0
        for sample in range(num_samples):
            thickness = float(sigmas[ray, sample]) * float(t_ends[ray, sample] - t_starts[ray, sample])
            weight = math.exp(-optical_depth) * -math.expm1(-thickness)
            weights[ray, sample] = weight
            for channel in range(3):
                colors[ray, channel] += weight * float(rgbs[ray, sample, channel])
            optical_depth += thickness
        left_over[ray] = math.exp(-optical_depth)
    return colors, weights, left_over
