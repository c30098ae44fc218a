"""The contract of a loss: the simulator's output and the batch in, one scalar out, logged under the loss's name."""

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.types import SimulatorOutput, VideoBatch


class AbstractLoss(nn.Module, ABC):
    """A term of the training objective, multiplied by ``weight``."""

    name: str
    weight: float

    @property
    def metrics(self) -> dict[str, Tensor]:
        """What the last call computed beside its value, by the name under which it is logged; without gradients."""
        return getattr(self, "measured", {})  # the older name, which losses of other packages may have

    @abstractmethod
    def forward(self, output: SimulatorOutput, batch: VideoBatch) -> Float[Tensor, ""]:
        """Return the unweighted value."""
