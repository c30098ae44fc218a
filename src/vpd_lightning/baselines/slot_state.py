"""What SAVi carries from frame to frame."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class SlotState:
    """The slots of the last frame and the predictor's recurrent state, so that a video can be encoded in pieces."""

    slots: Float[Tensor, "batch slot dim"]
    hidden: Float[Tensor, "batch slot recurrent"]
    cell: Float[Tensor, "batch slot recurrent"]
