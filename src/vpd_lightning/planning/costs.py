"""What a plan should reach, measured on predicted particles. Costs are in metres: less is better, 0 is reached.

A cost is called with the predicted states (``Particles`` with a batch of candidates, one for each step) and returns a
number for each candidate. It is about a ``Body``, or about particles that are ``chosen`` (``particle``, of those in the
scene).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.planning.bodies import Body
from vpd_lightning.types import Particles

Cost = Callable[[Sequence[Particles]], Float[Tensor, " batch"]]

_PATH_SHARE = 0.1
"""Of the mean over the steps, beside the last one: what gets there earlier is better."""


def _at_the_end(distances: Float[Tensor, "batch step"]) -> Float[Tensor, " batch"]:
    return distances[:, -1] + _PATH_SHARE * distances.mean(dim=1)


def _places(states: Sequence[Particles], chosen: Bool[Tensor, " particle"]) -> Float[Tensor, "batch step chosen 3"]:
    if not bool(chosen.any()):
        raise ValueError("a cost needs at least one particle to be about, and none is chosen")
    return torch.stack([state.positions[:, chosen.to(state.positions.device)] for state in states], dim=1)


@dataclass(frozen=True)
class TargetPose:
    """Particles of a body should be at ``goals`` (metres): the mean distance of each from its own goal."""

    chosen: Bool[Tensor, " particle"]
    goals: Float[Tensor, "chosen 3"]

    def __call__(self, states: Sequence[Particles]) -> Float[Tensor, " batch"]:
        """Return the cost of each candidate."""
        places = _places(states, self.chosen)
        return _at_the_end((places - self.goals.to(places)).norm(dim=-1).mean(dim=-1))


@dataclass(frozen=True)
class TargetPlace:
    """The middle of a body should be at ``goal`` (metres), however it is turned.

    ``axes`` are those that count: (0, 1) leaves the height open. What rolls is not there to stay: its last velocity
    counts as the distance that it makes in ``stopping`` steps.
    """

    body: Body
    goal: Float[Tensor, " axis"]
    axes: tuple[int, ...] = (0, 1, 2)
    stopping: float = 0.0

    def __call__(self, states: Sequence[Particles]) -> Float[Tensor, " batch"]:
        """Return the cost of each candidate."""
        middles = self.body.middles(states)[..., list(self.axes)]
        cost = _at_the_end((middles - self.goal.to(middles)).norm(dim=-1))
        if self.stopping and len(states) > 1:
            cost = cost + self.stopping * (middles[:, -1] - middles[:, -2]).norm(dim=-1)
        return cost


@dataclass(frozen=True)
class OutOfRegion:
    """Bodies should leave a disc or, where ``half_size`` has two numbers, a rectangle about ``middle`` (x and y).

    For each body: how deep its middle is inside, by the shortest way out, and 0 outside by ``margin`` (metres) or more.
    """

    bodies: Sequence[Body]
    middle: Float[Tensor, "2"]
    half_size: Float[Tensor, " size"]
    margin: float = 0.0

    def __call__(self, states: Sequence[Particles]) -> Float[Tensor, " batch"]:
        """Return the cost of each candidate: the sum over the bodies."""
        total = []
        for body in self.bodies:
            away = body.middles(states)[..., :2]
            away = away - self.middle.to(away)
            if len(self.half_size) == 1:
                inside = self.half_size[0].to(away) - away.norm(dim=-1)
            else:
                inside = (self.half_size.to(away) - away.abs()).amin(dim=-1)
            total.append(_at_the_end((inside + self.margin).clamp(min=0)))
        return torch.stack(total).sum(dim=0)


@dataclass(frozen=True)
class ChamferToCloud:
    """Particles should look like a cloud of points (metres), such as that of a goal picture: mean Chamfer distance."""

    chosen: Bool[Tensor, " particle"]
    cloud: Float[Tensor, "point 3"]

    def __call__(self, states: Sequence[Particles]) -> Float[Tensor, " batch"]:
        """Return the cost of each candidate at the last step."""
        places = _places(states[-1:], self.chosen)[:, 0]
        goal = self.cloud.to(places)
        gaps = (places[:, :, None] - goal).norm(dim=-1)
        return (gaps.amin(dim=2).mean(dim=1) + gaps.amin(dim=1).mean(dim=1)) / 2


@dataclass(frozen=True)
class NearTool:
    """The tool should come near a body, so that a plan that is still far from touching it is led there.

    ``weight`` times the distance in the plane between both middles, at the step where it is least.
    """

    body: Body
    weight: float

    def __call__(self, states: Sequence[Particles]) -> Float[Tensor, " batch"]:
        """Return the cost of each candidate."""
        places = self.body.middles(states)
        tools = torch.stack([_tool_middle(state) for state in states], dim=1)
        return self.weight * (places - tools)[..., :2].norm(dim=-1).amin(dim=1)


@dataclass(frozen=True)
class BehindBody:
    """The tool should come to where it can push a body towards ``goal`` (metres, x and y): to its far side.

    ``weight`` times the distance in the plane from there, at the step where it is least.
    """

    body: Body
    goal: Float[Tensor, "2"]
    weight: float

    def __call__(self, states: Sequence[Particles]) -> Float[Tensor, " batch"]:
        """Return the cost of each candidate."""
        places = self.body.middles(states)[..., :2]
        tools = torch.stack([_tool_middle(state) for state in states], dim=1)[..., :2]
        way = self.goal.to(places) - places
        way = way / way.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        reach = self.body.radius + _tool_radius(states[0])
        return self.weight * (places - reach * way - tools).norm(dim=-1).amin(dim=1)


def _tool_radius(state: Particles) -> float:
    """Return half of the tool's widest extent in the plane (metres)."""
    assert state.driven is not None
    points = state.driven.positions[0][state.driven.mask[0], :2]
    return float((points.amax(dim=0) - points.amin(dim=0)).max()) / 2


def _tool_middle(state: Particles) -> Float[Tensor, "batch 3"]:
    driven = state.driven
    if driven is None:
        raise ValueError("the scene has nothing that is driven: encode it with driven=")
    share = driven.mask[..., None].to(driven.positions)
    return (driven.positions * share).sum(dim=1) / share.sum(dim=1)


@dataclass(frozen=True)
class Sum:
    """The sum of several costs."""

    parts: Sequence[Cost]

    def __call__(self, states: Sequence[Particles]) -> Float[Tensor, " batch"]:
        """Return the cost of each candidate."""
        return torch.stack([part(states) for part in self.parts]).sum(dim=0)
