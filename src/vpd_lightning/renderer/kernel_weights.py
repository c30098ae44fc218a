"""Shares of particles in the layers of a ray, under Gaussian kernels of several widths: values and gradients."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.geometry.decay import NEGLIGIBLE

_SMALLEST_TOTAL = 1e-30  # a total is at least 1, but where nothing is usable


def kernel_weights(
    memberships: Float[Tensor, "batch ray layer candidate"],
    square: Float[Tensor, "batch ray candidate"],
    usable: Bool[Tensor, "batch ray candidate"],
    scales: Float[Tensor, " scale"],
) -> tuple[Float[Tensor, "batch ray layer scale candidate"], Float[Tensor, "batch ray layer scale 1"]]:
    """Return the softmax over the candidates of ``memberships - square / (2 scales^2)``, and the log of its total.

    What is not usable has no share; where nothing is usable all shares are zero.

    Args:
        memberships: log-weights of the candidates in each layer; about -1e30 where they are not usable.
        square: their squared distances from the ray (square metres).
        usable: which of them count.
        scales: standard deviations of the kernels (metres).

    Autograd would write a dozen tensors of the largest shape; here one is written and kept, and one in the backward
    pass.
    """
    return _KernelWeights.apply(memberships, square, usable, 0.5 / scales.square())  # type: ignore[no-any-return]


class _KernelWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, memberships: Tensor, square: Tensor, usable: Tensor, factors: Tensor) -> tuple[Tensor, ...]:
        weights = memberships[:, :, :, None] - (square[:, :, None] * factors[:, None])[:, :, None]
        top = weights.amax(dim=-1, keepdim=True)
        weights.sub_(top).clamp_(min=NEGLIGIBLE).exp_().mul_(usable[:, :, None, None])
        total = weights.sum(dim=-1, keepdim=True).clamp_(min=_SMALLEST_TOTAL)
        weights.div_(total)
        ctx.save_for_backward(weights, factors)
        return weights, top + total.log()

    @staticmethod
    @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, to_weights: Tensor, to_log_total: Tensor) -> tuple[Tensor | None, ...]:
        weights, factors = ctx.saved_tensors
        to_logits = to_weights * weights
        rest = to_log_total - to_logits.sum(dim=-1, keepdim=True)
        to_logits.addcmul_(rest, weights)
        to_square = None
        if ctx.needs_input_grad[1]:
            to_square = -(to_logits.sum(dim=2) * factors[:, None]).sum(dim=2)
        return to_logits.sum(dim=3), to_square, None, None
