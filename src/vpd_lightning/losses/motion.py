"""Predicted particles held against where things are seen later: self-supervision of motion by RGB-D alone."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.errors import ConfigError
from vpd_lightning.geometry.decay import decay
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.types import SimulatorOutput, VideoBatch

_OUTLIER = 0.05
"""Added to the evidence of every particle, so that one hidden in the later frame costs a bounded amount."""


class MotionLoss(AbstractLoss):
    """Negative log-evidence of predicted particles given the points seen at that step, and of these given those.

    The evidence of a particle is the sum of Gaussian kernels in space (``scales``, metres) and colour
    (``color_scale``) at the points that may move in the later frame, as in coherent point drift (Myronenko and Song
    2010); that of a point is the same sum at the particles, so that no point is left unexplained. Averaged over scales:
    the widest gives a direction from afar, the narrowest a precise position. Neither masks nor tracks are used, only
    depth and colour of the frames that a video has anyway.
    """

    # Paper: trains on colours of rendered rays alone. There, motion reaches the dynamics only through the renderer.

    name = "motion"

    def __init__(self, *, weight: float, scales: Sequence[float], color_scale: float, num_particles: int):
        super().__init__()
        if weight < 0 or color_scale <= 0 or not scales or min(scales) <= 0 or num_particles < 1:
            raise ValueError(
                "weight must not be negative, scales and color_scale must be positive, num_particles at least 1; got "
                f"{weight}, {list(scales)}, {color_scale}, {num_particles}"
            )
        self.weight, self.scales, self.color_scale = weight, list(scales), color_scale
        self.num_particles = num_particles

    def forward(self, output: SimulatorOutput, batch: VideoBatch) -> Float[Tensor, ""]:
        """Return the mean over steps and scales.

        Raises:
            ConfigError: the batch holds no future frames, or the encoder gives no mask of what may move.
        """
        first = output.states[0]
        if "future_positions" not in output.auxiliary or first.moving is None or first.colors is None:
            raise ConfigError(
                "the loss motion needs future frames and an encoder that tells what may move.\n"
                "Set data.load_future=true, and encoder=unet_objects."
            )
        index, valid = _first_of(first.mask & first.moving, self.num_particles)
        positions = torch.stack([_take(state.positions, index) for state in output.states], dim=1)
        colors = _take(first.colors, index)[:, None].expand_as(positions)
        seen, seen_colors = output.auxiliary["future_positions"], output.auxiliary["future_colors"]
        valid = valid[:, None].expand(positions.shape[:-1])
        with torch.autocast(positions.device.type, enabled=False):  # geometry in full precision: squares cancel
            return self._evidence_cost(positions, colors, valid, seen, seen_colors, output.auxiliary["future_mask"])

    def _evidence_cost(
        self, positions: Tensor, colors: Tensor, valid: Tensor, seen: Tensor, seen_colors: Tensor, seen_mask: Tensor
    ) -> Float[Tensor, ""]:
        middle = positions[:, :1].mean(dim=2, keepdim=True).detach()  # far from the origin, squares have few digits
        square = _squared_distances(positions - middle, seen - middle)
        tone = _squared_distances(colors, seen_colors) / (2 * self.color_scale**2)
        particles, points = valid.to(square.dtype), seen_mask.to(square.dtype)
        total = []
        for scale in self.scales:
            evidence = decay(square * (-0.5 / scale**2) - tone)
            total += [_cost(evidence @ points[..., None], particles), _cost(evidence.mT @ particles[..., None], points)]
        return torch.stack(total).sum() / len(self.scales)


def _squared_distances(first: Tensor, second: Tensor) -> Tensor:
    """Return those of all pairs, in product form: several times faster than differences where there is a gradient."""
    square = first.square().sum(dim=-1)[..., :, None] + second.square().sum(dim=-1)[..., None, :]
    return (square - 2 * first @ second.mT).clamp(min=0)


def _cost(evidence: Tensor, valid: Tensor) -> Tensor:
    """Return the mean negative log-evidence (``... any 1``) of what is valid: of each member, then of all."""
    cost = -torch.log(evidence.squeeze(-1) + _OUTLIER)
    return ((cost * valid).sum(dim=(1, 2)) / valid.sum(dim=(1, 2)).clamp(min=1)).mean()


def _first_of(chosen: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return slots of the first chosen particles (slots are in random order), and which of them are valid."""
    index = torch.sort((~chosen).to(torch.uint8), dim=1, stable=True).indices[:, :count]
    return index, torch.gather(chosen, 1, index)


def _take(values: Tensor, index: Tensor) -> Tensor:
    return torch.gather(values, 1, index[..., None].expand(-1, -1, values.shape[-1]))
