"""How large the error of ``max_radius`` of ``PointNeRFRenderer`` can get, derived and computed.

All of these bound the difference to the same renderer without a radius, in exact arithmetic; rounding comes on
top (about 1e-6 of a colour in float32).

Notation, for one ray: optical depths ``tau_i = sigma_i dt_i``, transmittances ``T_i = exp(-sum_{j<i} tau_j)``, weights
``w_i = T_i - T_{i+1}``, colours ``c_i`` in [0, 1] per channel, and for N samples

    C = sum_i w_i c_i + T_N c_{N-1}

the colour, a weighted mean of the samples' colours. The light behind sample i, as seen from just behind it, is

    B_i = (sum_{j>i} w_j c_j + T_N c_{N-1}) / T_{i+1},    also a mean of colours, so in [0, 1].
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from vpd_lightning.renderer.field.radiance_field import RadianceField


@dataclass(frozen=True)
class RenderingError:
    """How far a ray can be off: each channel of its colour, its depth (metres), its opacity."""

    color: float
    depth: float
    opacity: float


def feature_error_bound(
    max_radius: float,
    num_neighbors: int,
    kernel_radii: Sequence[float],
    kernel_bandwidths: Sequence[float],
    max_feature: float,
) -> list[float]:
    """Bound, for each kernel, the change of any channel of the annular features when neighbours are cut at a radius.

    A neighbour at a distance d > R leaves the sum with ``k(d) z = exp(-((d - r) / b)^2) z``. For ``R >= r`` the kernel
    falls from R on, so ``k(d) <= exp(-((R - r) / b)^2)``; for ``R < r`` it is at most 1. At most ``num_neighbors``
    leave, and those within R stay the same ones (they are the nearest), so

        |df| <= num_neighbors * k_R * max|z|.

    ``max_feature`` is ``max|z|``, the largest absolute value among the particles' features.
    """
    bounds = []
    for radius, bandwidth in zip(kernel_radii, kernel_bandwidths, strict=True):
        beyond = max(0.0, max_radius - radius)
        bounds.append(num_neighbors * math.exp(-((beyond / bandwidth) ** 2)) * max_feature)
    return bounds


def radius_for(
    tolerance: float,
    num_neighbors: int,
    kernel_radii: Sequence[float],
    kernel_bandwidths: Sequence[float],
    max_feature: float,
) -> float:
    """Return the smallest ``max_radius`` (metres) for which ``feature_error_bound`` is at most ``tolerance``.

    Solved for R, the widest kernel decides: ``R = max(r + b sqrt(log(num_neighbors max|z| / tolerance)))``.

    Raises:
        ValueError: when ``tolerance`` is not greater than 0.
    """
    if not tolerance > 0:
        raise ValueError(f"tolerance must be greater than 0, got {tolerance}.")
    excess = num_neighbors * max_feature / tolerance
    if excess <= 1:  # even all neighbours together stay below it
        return 0.0
    reach = math.sqrt(math.log(excess))
    pairs = zip(kernel_radii, kernel_bandwidths, strict=True)
    return max(radius + bandwidth * reach for radius, bandwidth in pairs)


def cut_norm(feature_errors: Sequence[float], feature_dim: int) -> float:
    """Return the Euclidean norm that errors of ``feature_error_bound`` in ``feature_dim`` channels each can have."""
    return math.sqrt(feature_dim * sum(error**2 for error in feature_errors))


@dataclass(frozen=True)
class Lipschitz:
    """By how much a network's density (per metre) and any channel of its colour change per norm of its features."""

    density: float
    color: float


@torch.no_grad()
def field_lipschitz(field: RadianceField) -> Lipschitz:
    """Bound how fast a radiance field changes with its features, whatever the direction and wherever it is.

    A linear layer stretches a difference by at most its spectral norm ``|W|``, ReLU and softplus not at all, a sigmoid
    by at most 1/4. So a trunk layer multiplies the bound of the layers before: ``l <- |W| l``. A layer behind a skip
    connection takes (hidden, features) with ``W = [A | F]``: ``l <- min(|A| l + |F|, |W| sqrt(l^2 + 1))``, by the
    triangle inequality or by the norm of the concatenation. The density is ``|w|`` times that. Bottleneck and the next
    layer have no activation between them and count as one matrix ``W_c W_b``; the direction adds the same to both
    sides of a difference. A channel of colour has a quarter of the norm of its row.

    True for every input, hence far above what a particular one shows.

    Raises:
        ValueError: a colour branch without a layer of its own.
    """
    bound = 0.0
    for index, (layer, takes_input) in enumerate(zip(field.trunk, field.takes_input, strict=True)):
        weight = layer.weight.double()  # type: ignore[union-attr, operator]
        if index == 0:
            bound = _spectral_norm(weight)
        elif takes_input:
            width = layer.out_features  # type: ignore[union-attr]
            parts = _spectral_norm(weight[:, :width]) * bound + _spectral_norm(weight[:, width:])
            bound = min(parts, _spectral_norm(weight) * math.hypot(bound, 1.0))
        else:
            bound *= _spectral_norm(weight)
    if field.condition is None:
        raise ValueError("This bound needs a colour branch with its own layer; net_width_condition is None.")
    condition = field.condition.weight.double()
    if field.bottleneck is not None:
        condition = condition[:, : field.bottleneck.out_features] @ field.bottleneck.weight.double()
    color = field.color.weight.double().norm(dim=1).amax()
    return Lipschitz(
        density=bound * float(field.density.weight.double().norm()),
        color=bound * _spectral_norm(condition) * float(color) / 4,
    )


def _spectral_norm(weight: Tensor) -> float:
    return float(torch.linalg.matrix_norm(weight, ord=2))


def rendering_error(density_error: float, color_error: float, near: float, far: float) -> RenderingError:
    """Bound what errors of every sample's density (per metre) and colour (per channel) make of a ray.

    The places of the samples are the same on both sides. Each ``tau_i`` enters C through its own weight and the
    transmittance of all that lies behind:

        dC/dtau_i = T_{i+1} c_i - (sum_{j>i} w_j c_j + T_N c_{N-1}) = T_{i+1} (c_i - B_i),    so |dC/dtau_i| <= 1,

    and ``dC/dc_i`` are weights that sum to one. Along the straight line between the two sets of (tau, c) colours stay
    in [0, 1] and optical depths at 0 or above, so by the mean value theorem

        |dC| <= sum_i |dtau_i| + max_i |dc_i| <= density_error (far - near) + color_error.

    With distances in the place of colours, which do not change: ``|dD| <= sum_i |dtau_i| (far - near)``. The opacity
    ``1 - exp(-sum_i tau_i)`` changes by at most ``sum_i |dtau_i|``. All of them are capped by their range.
    """
    optical = density_error * (far - near)
    return RenderingError(
        min(1.0, optical + min(1.0, color_error)), min(1.0, optical) * (far - near), min(1.0, optical)
    )


def feature_noise_error(field: RadianceField, norm: float, near: float, far: float) -> RenderingError:
    """Bound what a ray changes when each sample's features change by at most ``norm`` (Euclidean).

    For ``max_radius`` the norm is ``cut_norm(feature_error_bound(...), feature_dim)``.
    """
    slope = field_lipschitz(field)
    return rendering_error(slope.density * norm, slope.color * norm, near, far)
