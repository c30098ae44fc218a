"""Kernels that fall off to nothing, without the numbers that make processors slow."""

from jaxtyping import Float
from torch import Tensor

NEGLIGIBLE = -60.0
"""Exponent from which on a kernel counts for nothing: its share is 1e-26."""


def decay(exponents: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return the exponential of exponents of at most about zero, those below ``NEGLIGIBLE`` raised to it.

    An exponential whose result is subnormal or zero in float32 (exponents below -87) takes 20 times as long as any
    other, and most pairs of points are that far apart.
    """
    return exponents.clamp(min=NEGLIGIBLE).exp()
