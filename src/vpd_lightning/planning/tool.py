"""A tool that is shifted in a plane without turning: from velocities to the motion of its points."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.types import Driven


@dataclass(frozen=True)
class PlanarTool:
    """A rigid tool, its limits and how an action is held.

    An action is a velocity along the world's x and y, in shares of ``max_speed`` (metres per step), and is held for
    ``hold`` steps. The mean of the tool's points stays between ``low`` and ``high`` (metres, x and y).
    """

    max_speed: float
    low: Sequence[float]
    high: Sequence[float]
    hold: int

    def __post_init__(self) -> None:
        if self.max_speed <= 0 or self.hold < 1 or any(a >= b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(
                f"max_speed must be positive, hold at least 1 and low below high, got {self.max_speed}, {self.hold}, "
                f"{list(self.low)} and {list(self.high)}"
            )

    def path(self, start: Float[Tensor, "2"], actions: Float[Tensor, "batch knot 2"]) -> Float[Tensor, "batch step 2"]:
        """Return where the tool's middle is after each step, within the limits of speed and place."""
        speed = actions.norm(dim=-1, keepdim=True).clamp(min=1e-9)
        velocities = self.max_speed * actions * (1 / speed).clamp(max=1)
        low, high = (torch.as_tensor(end).to(start) for end in (self.low, self.high))
        places, place = [], start.expand(len(actions), -1)
        for velocity in velocities.repeat_interleave(self.hold, dim=1).unbind(dim=1):
            # From outside the limits it may come back, and no farther out.
            place = torch.maximum(
                torch.minimum(place + velocity, torch.maximum(high, place)), torch.minimum(low, place)
            )
            places.append(place)
        return torch.stack(places, dim=1)

    def motion(self, driven: Driven, actions: Float[Tensor, "batch knot 2"]) -> Driven:
        """Return the motion (axes ``batch step driven``) of a tool that is at ``driven`` now (batch axis of 1)."""
        here = driven.positions[0]
        start = here[driven.mask[0], :2].mean(dim=0)
        shift = torch.nn.functional.pad(self.path(start, actions.to(start)) - start, (0, 1))
        count, steps = shift.shape[:2]

        def held(values: Tensor) -> Tensor:
            return values[:, None].expand(count, steps, *values.shape[1:])

        moved = replace(driven, features=None, next_positions=None, next_normals=None).mapped(held)
        return replace(moved, positions=here + shift[:, :, None])
