"""Tasks on a table: what should be where at the end, as a cost for a planner and as a judgement of what happened."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.planning.bodies import Body
from vpd_lightning.planning.costs import BehindBody, Cost, NearTool, OutOfRegion, Sum, TargetPlace

Kind = Literal["place", "off_table", "make_room"]
KINDS: tuple[Kind, ...] = ("place", "off_table", "make_room")

PLACE_TOLERANCE = 0.03  # metres, of a body's centre
ROOM_RADIUS = 0.10  # metres, of the disc that should be free of centres
FALLEN = -0.05  # metres, of a centre, below the table's top
_PUSH = (0.10, 0.16)  # metres, from a body's first place to its goal
_FROM_EDGE = 0.08  # metres, of a goal
_MARGIN = 0.02  # metres, by which plans leave a region, and observed bodies must be where they should
_APPROACH = 0.3  # of the distance between tool and body, beside the cost of the task
_STOPPING = 4.0  # steps at its last velocity that a body at its place still seems away from it
_MAX_TRIALS = 1000


@dataclass(frozen=True)
class Task:
    """One task. Body 0 is the one to be moved; others may be in the way.

    ``goal`` (2,) is where its centre should be (``place``), or the middle of the disc to be freed (``make_room``);
    ``half_size`` (2,) is that of the table about the origin. Metres.
    """

    kind: Kind
    goal: NDArray[np.float64]
    half_size: NDArray[np.float64]

    def is_solved(self, places: NDArray[np.float64]) -> bool:
        """Return whether bodies whose true centres are ``places`` (body, 3) solve the task."""
        if self.kind == "off_table":
            return bool(places[0, 2] < FALLEN)
        if self.kind == "make_room":
            inside = np.hypot(*(places[:, :2] - self.goal).T) < ROOM_RADIUS
            return not bool((inside & (places[:, 2] > FALLEN)).any())
        return bool(np.hypot(*(places[0, :2] - self.goal)) < PLACE_TOLERANCE and places[0, 2] > FALLEN)

    def seems_solved(self, places: NDArray[np.float64]) -> bool:
        """Return whether a tool may rest where bodies were observed at ``places`` (body, 3): solved with a margin."""
        if self.kind == "off_table":
            return self.is_solved(places)
        away = np.hypot(*(places[:, :2] - self.goal).T)
        on_table = places[:, 2] > FALLEN
        if self.kind == "make_room":
            return not bool(((away < ROOM_RADIUS + _MARGIN) & on_table).any())
        return bool(away[0] < PLACE_TOLERANCE - _MARGIN and on_table[0])

    def distance(self, places: NDArray[np.float64]) -> float:
        """Return how far true centres (body, 3) are from solving the task (metres)."""
        if self.kind == "place":
            return float(np.hypot(*(places[0, :2] - self.goal)))
        if self.kind == "off_table":
            return max(0.0, float((self.half_size - np.abs(places[0, :2])).min())) if places[0, 2] > FALLEN else 0.0
        inside = ROOM_RADIUS - np.hypot(*(places[:, :2] - self.goal).T)
        return float(np.where(places[:, 2] > FALLEN, inside.clip(min=0), 0.0).sum())

    def cost(self, bodies: list[Body]) -> Cost:
        """Return what a plan should lower; the first of the bodies is the one to be moved."""
        goal = torch.from_numpy(self.goal)
        near = NearTool(bodies[0], _APPROACH)
        if self.kind == "place":
            return place_cost(bodies[0], goal)
        if self.kind == "off_table":
            return Sum([OutOfRegion(bodies[:1], 0 * goal, torch.from_numpy(self.half_size), 2 * _MARGIN), near])
        return Sum([OutOfRegion(bodies, goal, torch.tensor([ROOM_RADIUS]), _MARGIN), near])


def place_cost(body: Body, goal: Float[Tensor, "2"]) -> Cost:
    """Return what a plan should lower so that a body comes to rest at ``goal`` (metres, x and y)."""
    return Sum([TargetPlace(body, goal, axes=(0, 1), stopping=_STOPPING), BehindBody(body, goal, _APPROACH)])


def draw_task(
    kind: Kind, places: NDArray[np.float64], half_size: NDArray[np.float64], generator: np.random.Generator
) -> Task:
    """Draw a task for bodies on a table of ``half_size`` (2,) metres whose centres are ``places`` (body, 3)."""
    here = places[0, :2]
    if kind != "place":
        return Task(kind, here.copy(), half_size)
    for _ in range(_MAX_TRIALS):
        angle, length = generator.uniform(0, 2 * np.pi), generator.uniform(*_PUSH)
        goal = here + length * np.array([np.cos(angle), np.sin(angle)])
        is_free = all(np.hypot(*(goal - other)) > _PUSH[0] for other in places[1:, :2])
        if (np.abs(goal) < half_size - _FROM_EDGE).all() and is_free:
            return Task(kind, goal, half_size)
    return Task(kind, here * 0.5, half_size)
