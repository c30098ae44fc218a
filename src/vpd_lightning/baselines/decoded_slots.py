"""What the decoder predicts from a set of slots."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class DecodedSlots:
    """The combined image and its layers; colours nominally in [-1, 1] but not bounded, masks sum to 1 over slots."""

    images: Float[Tensor, "*shape 3 height width"]
    rgbs: Float[Tensor, "*shape slot 3 height width"]
    masks: Float[Tensor, "*shape slot 1 height width"]
