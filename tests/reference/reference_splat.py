"""The splat renderer in NumPy and float64, one ray after the other."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.types import Particles, Rays, RenderedRays

Array = NDArray[np.float64]


def splat_picture(renderer: SplatRenderer, particles: Particles, rays: Rays) -> RenderedRays:
    """Render in NumPy and float64, one ray after the other, whatever the precision of what is given.

    Nothing is shared with the renderer but its weights and settings: particles that are masked or not in front of the
    camera are taken out instead of being given a small weight.
    """
    network, background = _linear_layers(renderer.network), _linear_layers(renderer.background)
    pictures = []
    for member in range(len(rays.origins)):
        valid = particles.mask[member]
        positions, features = (_array(t[member][valid]) for t in (particles.positions, particles.features))
        origins, directions = _array(rays.origins[member]), _array(rays.directions[member])
        pictures.append([
            _ray(renderer, network, background, positions, features, origin, direction)
            for origin, direction in zip(origins, directions, strict=True)
        ])  # fmt: skip
    values = torch.tensor(np.array(pictures, dtype=np.float64)).reshape(*rays.origins.shape[:2], 5)
    return RenderedRays(values[..., :3], values[..., 3], values[..., 4])


def _ray(
    renderer: SplatRenderer,
    network: list[tuple[Array, Array]],
    background: list[tuple[Array, Array]],
    positions: Array,
    features: Array,
    origin: Array,
    direction: Array,
) -> list[float]:
    """Return red, green, blue, depth and opacity of one ray; ``positions`` and ``features`` hold no padding."""
    waves = [np.exp(1j * np.pi * 2**octave * direction) for octave in range(renderer.background.frequencies)]
    encoded = np.concatenate([direction, *(part for wave in waves for part in (wave.imag, wave.real))])
    behind_all = _sigmoid(_evaluate(background, encoded))
    offsets = positions - origin
    along = offsets @ direction
    besides = offsets - np.outer(along, direction)
    square = np.sum(besides**2, axis=1)
    in_front = np.flatnonzero(along > renderer.near)
    if len(in_front) == 0:
        return [*behind_all, renderer.far, 0.0]
    chosen = in_front[_closest(renderer, along[in_front], square[in_front])]
    along, besides, square, features = along[chosen], besides[chosen], square[chosen], features[chosen]

    border = np.min(along + 2 * np.sqrt(square)) + renderer.layer_depth
    how_far_in_front = (border - along) / (0.3 * renderer.layer_depth)
    inputs: list[Any] = []
    distances, colors = [], []
    for log_membership in (-np.logaddexp(0, -how_far_in_front), -np.logaddexp(0, how_far_in_front)):
        log_membership = np.maximum(log_membership, -30)
        for scale in renderer.kernel_scales:
            logs = log_membership - square / (2 * scale**2)
            log_sum = np.max(logs) + np.log(np.sum(np.exp(logs - np.max(logs))))
            weights = np.exp(logs - log_sum)
            inputs += [weights @ features, weights @ besides / scale, [max(log_sum, -10) / 5]]
            if scale == renderer.kernel_scales[0]:
                distances.append(weights @ along)
                colors.append((weights @ features)[:3])
        inputs.append([np.log(1 + np.sum(np.exp(log_membership)))])
    outputs = _evaluate(network, np.concatenate([*inputs, direction]))

    if renderer.color_features:
        shown = np.clip(np.concatenate(colors), 0.01, 0.99)
        outputs[:6] += np.log(shown / (1 - shown))
    front_color, back_color = _sigmoid(outputs[:3]), _sigmoid(outputs[3:6])
    front, back = _sigmoid(outputs[6:] + 1)
    back *= 1 - front
    left = 1 - front - back
    color = front * front_color + back * back_color + left * behind_all
    depth = front * distances[0] + back * distances[1] + left * renderer.far
    return [*color, depth, front + back]


def _closest(renderer: SplatRenderer, along: Array, square: Array) -> NDArray[np.int64]:
    """Return the particles with the smallest scores."""
    half_width = renderer.kernel_scales[-1] / 2
    first = np.min(along + 500 / half_width * np.maximum(square - half_width**2, 0))
    score = square + 0.04 * np.maximum(along - first - 3 * renderer.layer_depth, 0) ** 2
    return np.argsort(score, kind="stable")[: renderer.num_candidates]


def _linear_layers(network: nn.Sequential) -> list[tuple[Array, Array]]:
    return [(_array(layer.weight), _array(layer.bias)) for layer in network if isinstance(layer, nn.Linear)]


def _evaluate(layers: list[tuple[Array, Array]], values: Array) -> Array:
    """Evaluate linear layers with a ReLU between two of them."""
    for number, (weight, bias) in enumerate(layers):
        values = weight @ (values if number == 0 else np.maximum(values, 0)) + bias
    return values


def _sigmoid(values: Array) -> Array:
    return 1 / (1 + np.exp(-values))


def _array(tensor: Tensor) -> Array:
    return tensor.detach().cpu().numpy().astype(np.float64)
