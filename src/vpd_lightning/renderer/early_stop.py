"""Evaluating samples from front to back, and leaving out those that hardly any light would reach."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.renderer.field.precision import at_least_float32, full_precision

Evaluate = Callable[[Tensor, slice], tuple[Tensor, Tensor]]
"""From indices of rays and a slice of their samples to densities (``ray sample``) and colours (``ray sample 3``)."""


def front_to_back(
    evaluate: Evaluate,
    t: Float[Tensor, "ray sample"],
    t_ends: Float[Tensor, "ray sample"],
    min_transmittance: float,
    num_segments: int,
) -> tuple[Float[Tensor, "ray sample"], Float[Tensor, "ray sample 3"]]:
    """Return densities (per metre) and colours of samples in front-to-back order, evaluated in ``num_segments`` parts.

    Before each part, rays with a transmittance below ``min_transmittance`` are left out for good. What is not evaluated
    is taken as empty, in the colour of the ray's last evaluated sample, so that this colour takes the light that is
    left there. See ``bounds.early_stop_error`` for what that changes in colours, depths, opacities and gradients.

    The first part is evaluated for every ray. Which rays are left depends on the numbers, so every further part waits
    for the device.
    """
    num_rays, num_samples = t.shape
    rays = torch.arange(num_rays, device=t.device)
    passed = t.new_zeros(num_rays, dtype=torch.promote_types(t.dtype, torch.float32))
    all_sigmas: list[Tensor] = []
    all_rgbs: list[Tensor] = []
    for start, stop in _segments(num_samples, num_segments):
        if all_sigmas:
            rays = (torch.exp(-passed) >= min_transmittance).nonzero()[:, 0]
        if len(rays) == num_rays:
            sigmas, rgbs = evaluate(rays, slice(start, stop))
        else:
            last = all_rgbs[-1][:, -1:]
            sigmas, rgbs = all_sigmas[-1].new_zeros(num_rays, stop - start), last.expand(num_rays, stop - start, 3)
            if len(rays):
                some_sigmas, some_rgbs = evaluate(rays, slice(start, stop))
                sigmas, rgbs = sigmas.index_copy(0, rays, some_sigmas), rgbs.index_copy(0, rays, some_rgbs)
        with torch.no_grad(), full_precision(t):
            optical_depth = at_least_float32(sigmas) * (t_ends[:, start:stop] - t[:, start:stop])
            passed = passed + optical_depth.sum(dim=-1)
        all_sigmas.append(sigmas)
        all_rgbs.append(rgbs)
    return torch.cat(all_sigmas, dim=1), torch.cat(all_rgbs, dim=1)


def _segments(num_samples: int, num_segments: int) -> list[tuple[int, int]]:
    """Cut samples into parts of equal size, as far as that goes; never an empty one."""
    edges = [round(part * num_samples / num_segments) for part in range(num_segments + 1)]
    return [(start, stop) for start, stop in zip(edges[:-1], edges[1:], strict=True) if stop > start]
