"""Volume rendering along rays: from densities and colours to one colour per ray."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.renderer.field.precision import at_least_float32, full_precision


def composite(
    sigmas: Float[Tensor, "*batch ray sample"],
    rgbs: Float[Tensor, "*batch ray sample 3"],
    t_starts: Float[Tensor, "*batch ray sample"],
    t_ends: Float[Tensor, "*batch ray sample"],
) -> tuple[Float[Tensor, "*batch ray 3"], Float[Tensor, "*batch ray sample"], Float[Tensor, "*batch ray"]]:
    """Return ``(rgb, weights, transmittance)`` of samples in front-to-back order; no background is added.

    ``weights_i = T_i (1 - exp(-sigma_i dt_i))`` with ``T_i = exp(-sum_{j<i} sigma_j dt_j)`` and
    ``dt_i = t_ends_i - t_starts_i`` (metres); ``transmittance`` is what is left behind the last sample, so that the
    weights sum to ``1 - transmittance``. Densities are per metre. Computed in at least float32, outside autocast
    (Mildenhall et al. 2020, equation 3).
    """
    weights, transmittance = ray_weights(sigmas, t_starts, t_ends)
    with full_precision(sigmas):
        rgb = (weights[..., None] * at_least_float32(rgbs)).sum(dim=-2)
    return rgb, weights, transmittance


def ray_weights(
    sigmas: Float[Tensor, "*batch ray sample"],
    t_starts: Float[Tensor, "*batch ray sample"],
    t_ends: Float[Tensor, "*batch ray sample"],
) -> tuple[Float[Tensor, "*batch ray sample"], Float[Tensor, "*batch ray"]]:
    """Return the weights and the transmittance of ``composite``, where no colours are at hand."""
    with full_precision(sigmas):
        optical_depth = at_least_float32(sigmas) * (at_least_float32(t_ends) - at_least_float32(t_starts))
        passed = torch.nn.functional.pad(optical_depth.cumsum(dim=-1), (1, 0))
        # A product of (1 - alpha) would underflow, and its gradient with it; 1 - exp(-x) would cancel for small x.
        weights = torch.exp(-passed[..., :-1]) * -torch.expm1(-optical_depth)
        return weights, torch.exp(-passed[..., -1])
