"""NeRF's network (jaxnerf's layout, the paper's widths) at one point, and its quadrature on one ray, in loops."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.reference.reference_compositing import composite
from tests.reference.reference_sampling import sample_pdf

Array = NDArray[np.float64]
Linear = tuple[Array, Array]


@dataclass(frozen=True)
class Field:
    """Weights (output input) and biases.

    Both networks have "8 layers of width 256 before concatenating view directions (if using), followed by 1 layer of
    width 128": without view directions the bottleneck that meets them is missing, the ``condition`` layer is not.
    """

    trunk: Sequence[Linear]
    density: Linear
    bottleneck: Linear | None
    condition: Linear
    color: Linear
    skip_layer: int


def _linear(layer: Linear, values: list[float]) -> list[float]:
    return [
        sum(float(w) * x for w, x in zip(row, values, strict=True)) + float(offset)
        for row, offset in zip(*layer, strict=True)
    ]


def encode_direction(direction: Array, degree: int) -> list[float]:
    """``(d, sin(2^0 d), cos(2^0 d), ..., sin(2^(L-1) d), cos(2^(L-1) d))``, three values each."""
    encoded = [float(value) for value in direction]
    for power in range(degree):
        encoded += [math.sin(2.0**power * float(value)) for value in direction]
        encoded += [math.cos(2.0**power * float(value)) for value in direction]
    return encoded


def evaluate(field: Field, feature: Array, direction: Array, view_degree: int) -> tuple[float, list[float]]:
    """Density (ReLU) and colour (sigmoid) of one point; the input joins again behind every ``skip_layer``-th layer."""
    inputs = [float(value) for value in feature]
    values = list(inputs)
    for number, layer in enumerate(field.trunk):
        values = [max(value, 0.0) for value in _linear(layer, values)]
        if number > 0 and number % field.skip_layer == 0:
            values = values + inputs
    density = max(_linear(field.density, values)[0], 0.0)
    if field.bottleneck is not None:
        values = _linear(field.bottleneck, values) + encode_direction(direction, view_degree)
    values = [max(value, 0.0) for value in _linear(field.condition, values)]
    return density, [1.0 / (1.0 + math.exp(-value)) for value in _linear(field.color, values)]


def quadrature(
    query: Callable[[float], tuple[float, list[float]]], t_starts: Array, t_ends: Array, t_samples: Array
) -> tuple[Array, Array, float]:
    """Colour with the left-over light in the colour of the last sample, weights, and left-over light of one ray."""
    answers = [query(float(t)) for t in t_samples]
    sigmas = np.array([[density for density, _ in answers]])
    rgbs = np.array([[color for _, color in answers]])
    colors, weights, left_over = composite(sigmas, rgbs, t_starts[None], t_ends[None])
    return colors[0] + left_over[0] * rgbs[0, -1], weights[0], float(left_over[0])


def render_ray(
    coarse: Callable[[float], tuple[float, list[float]]],
    fine: Callable[[float], tuple[float, list[float]]],
    t_coarse: Array,
    u: Array,
) -> tuple[Array, Array]:
    """Coarse and fine colour of one ray (Mildenhall et al. 2020, section 5.2).

    The fine samples are drawn where the coarse weights are: bins between the middles of neighbouring coarse samples,
    weights of the samples within them (jaxnerf). The fine network sees the sorted union of both sets.
    """
    coarse_color, weights, _ = quadrature(coarse, *_intervals(t_coarse), t_coarse)
    middles = np.array([(a + b) / 2 for a, b in zip(t_coarse[:-1], t_coarse[1:], strict=True)])
    drawn = sample_pdf(middles[None], weights[None, 1:-1], u[None])[0]
    t_fine = np.array(sorted([*t_coarse, *drawn]))
    fine_color, _, _ = quadrature(fine, *_intervals(t_fine), t_fine)
    return coarse_color, fine_color


def _intervals(t: Array) -> tuple[Array, Array]:
    """Each sample stands for the way to the next; how long the last one is does not matter to the colour.

    Its weight and what is left behind it both carry its colour.
    """
    return t, np.array([*t[1:], t[-1]])
