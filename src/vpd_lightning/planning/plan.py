"""Plan what a tool does: candidates roll out side by side from one encoded scene, and a solver picks among them."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.errors import ActionError
from vpd_lightning.planning.costs import Cost
from vpd_lightning.planning.solvers import Solver
from vpd_lightning.planning.tool import PlanarTool
from vpd_lightning.simulator import Scene, Simulator
from vpd_lightning.types import Driven, Particles

Progress = Callable[[int, int, float], None]
"""Called with the candidates evaluated, how many there will be, and the least cost yet."""


@dataclass(frozen=True)
class Plan:
    """What to do and what is expected: actions, motion of the tool and particles after each step (batch axis of 1)."""

    actions: Float[Tensor, "knot 2"]
    motion: Driven
    states: list[Particles]
    cost: float
    history: list[float]
    num_candidates: int
    seconds: float

    def later(self, num_knots: int) -> Float[Tensor, "knot 2"]:
        """Return the actions that are left after the first ones, and then none: a warm start."""
        done = min(num_knots, len(self.actions))
        return torch.cat([self.actions[done:], torch.zeros_like(self.actions[:done])])


def plan(
    simulator: Simulator,
    scene: Scene,
    cost: Cost,
    *,
    tool: PlanarTool,
    solver: Solver,
    num_knots: int,
    start: Float[Tensor, "knot 2"] | None = None,
    seed: int = 0,
    commanded: Float[Tensor, "2"] | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Return the best of the solver's candidates of ``num_knots`` actions for an encoded scene.

    ``start`` are actions to begin with (``Plan.later`` of the plan before); without, the tool stays. ``commanded`` is
    where the tool was last commanded to be (metres); without, it is there.

    Raises:
        ActionError: nothing in the scene is driven.
        ValueError: ``start`` has another shape.
    """
    began = time.perf_counter()
    driven = scene.current.driven
    if driven is None:
        raise ActionError("there is nothing to plan for: encode the scene with what is driven (driven=).")
    first = torch.zeros(num_knots, 2) if start is None else start
    if first.shape != (num_knots, 2):
        raise ValueError(f"start must be ({num_knots}, 2), got {tuple(first.shape)}")
    done = 0
    total = solver.num_samples * solver.num_iterations
    least = float("inf")

    def evaluate(candidates: Tensor) -> Tensor:
        nonlocal done, least
        states = simulator.rollout(scene, num_knots * tool.hold, driven=tool.motion(driven, candidates, commanded))
        costs = cost(states)
        done, least = done + len(candidates), min(least, float(costs.min()))
        if progress is not None:
            progress(done, total, least)
        return costs

    with torch.no_grad():
        found = solver.solve(evaluate, first.to(driven.positions), seed)
        motion = tool.motion(driven, found.actions[None], commanded)
        states = simulator.rollout(scene, num_knots * tool.hold, driven=motion)
    return Plan(
        actions=found.actions.cpu(),
        motion=motion[0],
        states=states,
        cost=found.cost,
        history=found.history,
        num_candidates=done,
        seconds=time.perf_counter() - began,
    )
