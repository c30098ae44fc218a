"""Hierarchical sampling along rays (Mildenhall et al. 2020, section 5.2; jaxnerf's variant), in float64 loops."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# jaxnerf adds this to every weight, so that a ray without any density is sampled uniformly.
WEIGHT_FLOOR = 1e-5


def sample_pdf(bins: Array, weights: Array, u: Array) -> Array:
    """Invert the cumulative distribution of a piecewise constant density: (ray bin+1), (ray bin), (ray n) -> (ray n).

    Within bin j, whose share of the mass is p_j, the sample is
    ``bins_j + (u - sum_{i<j} p_i) / p_j * (bins_{j+1} - bins_j)``.
    """
    num_rays, num_bins = weights.shape
    samples = np.zeros(u.shape)
    for ray in range(num_rays):
        total = sum(float(weight) + WEIGHT_FLOOR for weight in weights[ray])
        for number, value in enumerate(u[ray]):
            below = 0.0
            for position in range(num_bins):
                share = (float(weights[ray, position]) + WEIGHT_FLOOR) / total
                if float(value) < below + share or position == num_bins - 1:
                    fraction = min(max((float(value) - below) / share, 0.0), 1.0)
                    left, right = float(bins[ray, position]), float(bins[ray, position + 1])
                    samples[ray, number] = left + fraction * (right - left)
                    break
                below += share
    return samples
