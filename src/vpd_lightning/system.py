"""What every trained system is to the code that trains and evaluates it."""

from abc import ABC, abstractmethod
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.types import Cameras, Driven, RGBDFrames, SimulatorOutput


class AbstractSystem(nn.Module, ABC):
    """A model of video that one LightningModule can train: its output and the batch go to the losses.

    The direct children of a system are its stages; an optimiser gives each its own learning rate.
    ``num_context_frames`` is the number of frames that ``predict_frames`` needs.
    """

    num_context_frames: int

    @abstractmethod
    def forward(self, batch: Any) -> SimulatorOutput:
        """Predict what the batch supervises."""

    @abstractmethod
    def predict_frames(
        self, context: RGBDFrames, cameras: Cameras, driven: Driven | None = None
    ) -> Float[Tensor, "step view height width 3"]:
        """Predict the images that ``cameras`` (axes ``step view``) see after the frames of ``context`` (``time view``).

        ``driven`` is what is given of the motion at these steps (axis ``step``), for systems that take actions.
        Without gradients and without randomness; colours in [0, 1].
        """
