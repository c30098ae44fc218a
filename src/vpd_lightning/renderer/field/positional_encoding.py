"""NeRF's encoding of a direction by sines and cosines of growing frequency."""

import torch
from jaxtyping import Float
from torch import Tensor


def positional_encoding(vectors: Float[Tensor, "*shape 3"], degree: int) -> Float[Tensor, "*shape encoding"]:
    """Return ``[x, sin(x), cos(x), sin(2x), cos(2x), ..., sin(2^(degree-1) x), cos(2^(degree-1) x)]``.

    Order and frequencies (no factor pi) are jaxnerf's; the length is ``encoding_dim(degree)``.
    """
    parts = [vectors]
    for power in range(degree):
        parts += [torch.sin(2**power * vectors), torch.cos(2**power * vectors)]
    return torch.cat(parts, dim=-1)


def encoding_dim(degree: int) -> int:
    """Return the length of the encoding of a 3-vector."""
    return 3 + 6 * degree
