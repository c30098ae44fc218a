"""Where along a ray a renderer looks: stratified samples, and samples drawn from a piecewise constant density."""

import torch
from jaxtyping import Float
from torch import Tensor

_PADDING = 1e-5
"""Added to every weight, so that a ray that hits nothing is sampled uniformly instead of dividing by zero."""


def stratified_samples(
    near: float, far: float, num_samples: int, num_rays: int, noise: Float[Tensor, "ray sample"] | None
) -> Float[Tensor, "ray sample"]:
    """Return ascending distances (metres) in ``[near, far]``, one per stratum.

    The strata meet halfway between ``num_samples`` evenly spaced distances. ``noise`` in [0, 1) places each sample in
    its stratum; without noise the evenly spaced distances themselves are returned, the same for each ray (jaxnerf).
    """
    dtype = torch.float32 if noise is None else torch.promote_types(noise.dtype, torch.float32)
    device = None if noise is None else noise.device
    even = torch.linspace(near, far, num_samples, dtype=dtype, device=device)
    if noise is None:
        return even.expand(num_rays, num_samples)
    middles = (even[1:] + even[:-1]) / 2
    lower = torch.cat([even[:1], middles])
    upper = torch.cat([middles, even[-1:]])
    return lower + (upper - lower) * noise


@torch.no_grad()
def sample_pdf(
    bins: Float[Tensor, "ray edge"], weights: Float[Tensor, "ray bin"], u: Float[Tensor, "ray sample"]
) -> Float[Tensor, "ray sample"]:
    """Return, for each ``u`` in [0, 1), the point where the cumulated share of ``weights`` over ``bins`` reaches it.

    The density is constant within a bin and proportional to ``weights + 1e-5`` (jaxnerf). ``bins`` are the ascending
    edges, one more than there are weights. Results carry no gradient and lie within the edges. At least float32.
    """
    with torch.autocast(bins.device.type, enabled=False):
        dtype = torch.promote_types(torch.promote_types(bins.dtype, weights.dtype), torch.float32)
        bins, weights, u = bins.to(dtype), weights.to(dtype) + _PADDING, u.to(dtype)
        cumulated = torch.nn.functional.pad(weights.cumsum(dim=-1), (1, 0))
        cumulated = cumulated / cumulated[..., -1:]
        upper = torch.searchsorted(cumulated.contiguous(), u.contiguous(), right=True)
        upper = upper.clamp(1, weights.shape[-1])
        start, stop = cumulated.gather(-1, upper - 1), cumulated.gather(-1, upper)
        first, last = bins.gather(-1, upper - 1), bins.gather(-1, upper)
        width = stop - start
        share = torch.where(width > 0, (u - start) / torch.where(width > 0, width, 1.0), 0.0).clamp(0.0, 1.0)
        return first + share * (last - first)


def even_quantiles(num_samples: int, num_rays: int, device: torch.device) -> Float[Tensor, "ray sample"]:
    """Return evenly spaced ``u`` from 0 to just below 1 for ``sample_pdf`` without randomness (jaxnerf)."""
    top = 1.0 - torch.finfo(torch.float32).eps
    return torch.linspace(0.0, top, num_samples, device=device).expand(num_rays, num_samples)
