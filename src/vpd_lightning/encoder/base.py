"""The contract of stage 2: the RGB-D frames of one time step in, latent particles out."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles, RGBDFrames


@dataclass(frozen=True)
class EncoderOutput:
    """Particles, and what an encoder offers beside them (for example predicted depth)."""

    particles: Particles
    auxiliary: dict[str, Tensor] = field(default_factory=dict)


class AbstractBackground(nn.Module, ABC):
    """Separates pixels of static surfaces from those that may move, in the frames of one time step.

    Where ``needs_fit``, training calls ``fit(rgb, depth, cameras)`` with the median images of fixed cameras first.
    """

    needs_fit = False

    @abstractmethod
    def forward(self, frames: RGBDFrames) -> Bool[Tensor, "batch view height width"]:
        """Return which pixels may be moving."""

    def restored(
        self, frames: RGBDFrames
    ) -> tuple[Float[Tensor, "batch view height width"], Float[Tensor, "batch view height width"]]:
        """Return the depth (metres) by which it is judged what moves, and that which places the particles.

        Here both are the measured one.
        """
        return frames.depth, frames.depth

    def trusted(
        self, frames: RGBDFrames, moving: Bool[Tensor, "batch view height width"]
    ) -> Bool[Tensor, "batch view height width"]:
        """Return which pixels measured a surface, given which may move; here all that have a depth."""
        return torch.isfinite(frames.depth) & (frames.depth > 0)


class AbstractEncoder(nn.Module, ABC):
    """Turns the RGB-D frames of one time step (axes ``batch view``) into particles."""

    # A default here would hide the submodule: class attributes win over nn.Module's registry.
    background: AbstractBackground | None

    @abstractmethod
    def forward(self, frames: RGBDFrames, keys: RandomKeys, purpose: str) -> EncoderOutput:
        """Encode; ``purpose`` separates the draws of the two context frames."""

    def observe(self, frames: RGBDFrames, keys: RandomKeys, purpose: str) -> dict[str, Tensor]:
        """Return what a loss on motion may compare with, by name, for frames of one time step; nothing by default.

        ``positions`` (``batch point 3``, metres), ``colors`` (in [0, 1]) and ``mask`` of points that may move, with
        the same number of points for every frame.
        """
        return {}
