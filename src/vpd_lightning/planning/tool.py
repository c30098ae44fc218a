"""A tool that is shifted in a plane without turning: from velocities to the motion of its points."""

import math
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
    ``hold`` steps. The mean of the tool's points stays between ``low`` and ``high`` (metres, x and y). Where position
    control follows what is commanded by some of a step later, ``lag`` says by how much of it (0 to 1).
    """

    max_speed: float
    low: Sequence[float]
    high: Sequence[float]
    hold: int
    lag: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.lag <= 1:
            raise ValueError(f"lag must lie between 0 and 1 step, got {self.lag}")
        if self.max_speed <= 0 or self.hold < 1 or any(a >= b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(
                f"max_speed must be positive, hold at least 1 and low below high, got {self.max_speed}, {self.hold}, "
                f"{list(self.low)} and {list(self.high)}"
            )

    def path(self, start: Float[Tensor, "2"], actions: Float[Tensor, "batch knot 2"]) -> Float[Tensor, "batch step 2"]:
        """Return where to command the tool's middle after each step, within the limits of speed and place."""
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

    def along(self, driven: Driven, stops: Float[Tensor, "stop 2"]) -> Driven:
        """Return the motion (axes ``step driven``) of a tool that is at ``driven`` now and goes from stop to stop.

        It goes straight, at ``max_speed``, within the limits; at least one step, in which it may stay.
        """
        here = self.middle(driven)
        low, high = (torch.as_tensor(end).to(here) for end in (self.low, self.high))
        places, place = [], here
        for stop in stops.to(here):
            way = torch.maximum(torch.minimum(stop, high), low) - place
            count = max(1, math.ceil(float(way.norm()) / self.max_speed - 1e-6))
            places += [place + way * (step + 1) / count for step in range(count)]
            place = places[-1]
        return self._carried(driven, torch.stack(places or [here])[None])[0]

    @staticmethod
    def middle(driven: Driven) -> Float[Tensor, "2"]:
        """Return where the middle of the tool's points is now, x and y (batch axis of 1)."""
        return driven.positions[0][driven.mask[0], :2].mean(dim=0)

    def motion(
        self,
        driven: Driven,
        actions: Float[Tensor, "batch knot 2"],
        commanded: Float[Tensor, "2"] | None = None,
    ) -> Driven:
        """Return the motion (axes ``batch step driven``) of a tool that is at ``driven`` now (batch axis of 1).

        ``commanded`` is where it was last told to be; without, it is there.
        """
        start = self.middle(driven) if commanded is None else commanded.to(driven.positions)
        commands = self.path(start, actions.to(start))
        before = torch.cat([start.expand(len(commands), 1, 2), commands[:, :-1]], dim=1)
        return self._carried(driven, torch.lerp(commands, before, self.lag))

    def _carried(self, driven: Driven, places: Float[Tensor, "batch step 2"]) -> Driven:
        """Return the tool at each place of its middle (axes ``batch step driven``)."""
        shift = torch.nn.functional.pad(places - self.middle(driven), (0, 1))
        count, steps = shift.shape[:2]

        def held(values: Tensor) -> Tensor:
            return values[:, None].expand(count, steps, *values.shape[1:])

        moved = replace(driven, features=None, next_positions=None, next_normals=None).mapped(held)
        return replace(moved, positions=driven.positions[0] + shift[:, :, None])
