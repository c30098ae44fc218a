"""An adapter: a trained simulator as what the solvers of stable-worldmodel call a model."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.planning.costs import Cost
from vpd_lightning.planning.tool import PlanarTool
from vpd_lightning.simulator import Scene, Simulator


class CostModel:
    """Implements the protocol ``Costable`` of stable-worldmodel 0.1: costs of candidate actions.

    ``set_task`` names the encoded scene and the cost; the solver's ``info_dict`` is then not looked at. Actions are
    those of ``PlanarTool``: shares of the largest speed along x and y, each held for ``hold`` steps.
    """

    def __init__(self, simulator: Simulator, tool: PlanarTool) -> None:
        self.simulator, self.tool = simulator, tool
        self._task: tuple[Scene, Cost] | None = None

    def set_task(self, scene: Scene, cost: Cost) -> None:
        """Plan from this scene on, for this cost."""
        self._task = scene, cost

    def parameters(self) -> Any:
        """Return the simulator's weights, whose precision the solvers take."""
        return self.simulator.parameters()

    @torch.no_grad()
    def get_cost(
        self, info_dict: Mapping[str, Any], action_candidates: Float[Tensor, "env sample knot 2"]
    ) -> Float[Tensor, "env sample"]:
        """Return the cost of each candidate.

        Raises:
            ValueError: no task was set, or the scene has nothing that is driven.
        """
        if self._task is None:
            raise ValueError("set_task says which scene the candidates start from; it was not called")
        scene, cost = self._task
        driven = scene.current.driven
        if driven is None:
            raise ValueError("the scene has nothing that is driven: encode it with driven=")
        candidates = action_candidates.flatten(0, 1).clamp(-1, 1)
        steps = candidates.shape[1] * self.tool.hold
        states = self.simulator.rollout(scene, steps, driven=self.tool.motion(driven, candidates))
        return cost(states).unflatten(0, action_candidates.shape[:2])

    criterion = get_cost
