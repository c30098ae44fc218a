"""Plans with a simulator in which everything follows the tool, so that the best plan is known. Metres."""

from dataclasses import replace

import pytest
import torch

from tests.test_actions import motion, scene_of, simulator
from vpd_lightning.errors import ActionError
from vpd_lightning.planning.bodies import Body
from vpd_lightning.planning.costs import TargetPlace
from vpd_lightning.planning.plan import plan
from vpd_lightning.planning.solvers import CrossEntropy, RandomShooting
from vpd_lightning.planning.tool import PlanarTool
from vpd_lightning.planning.worldmodel import CostModel

TOOL = PlanarTool(0.05, low=(-2.0, -2.0), high=(2.0, 2.0), hold=2)
SOLVER = CrossEntropy(num_samples=12, num_iterations=4, num_elites=3, spread=0.7)


@pytest.fixture(scope="module")
def given():
    model = simulator().eval()
    scene = scene_of(model, motion()[:2])
    chosen = scene.current.mask[0]
    here = scene.current.positions[0, chosen].mean(dim=0)
    goal = here[:2] + torch.tensor([0.15, -0.1]).double()
    return model, scene, TargetPlace(Body.of(scene.current, chosen), goal, axes=(0, 1)), here


def test_a_plan_comes_near_its_goal_and_says_what_is_expected(given) -> None:
    model, scene, cost, here = given
    calls: list[tuple[int, int, float]] = []
    found = plan(model, scene, cost, tool=TOOL, solver=SOLVER, num_knots=3, progress=lambda *told: calls.append(told))
    start = float((here[:2] - cost.goal).norm())
    assert found.cost < 0.5 * start and len(found.states) == 6 and found.motion.positions.shape[0] == 6
    assert found.actions.shape == (3, 2) and found.num_candidates == 48
    assert float(cost(found.states)) == pytest.approx(found.cost, abs=1e-6), "the states are those of the plan"
    reached = found.states[-1].positions[0, cost.body.chosen].mean(dim=0)
    assert torch.allclose(
        reached - here, (found.motion.positions[-1] - scene.current.driven.positions[0])[0], atol=1e-6
    )
    assert [told[:2] for told in calls] == [(12, 48), (24, 48), (36, 48), (48, 48)]


def test_a_warm_start_is_kept_or_bettered(given) -> None:
    model, scene, cost, _ = given
    first = plan(model, scene, cost, tool=TOOL, solver=SOLVER, num_knots=3)
    again = plan(model, scene, cost, tool=TOOL, solver=SOLVER, num_knots=3, start=first.actions, seed=9)
    assert again.cost <= first.cost + 1e-9
    later = first.later(2)
    assert torch.equal(later[0], first.actions[2]) and not later[1:].any()


def test_what_cannot_be_planned_is_refused(given) -> None:
    model, scene, cost, _ = given
    bare = replace(scene, current=replace(scene.current, driven=None))
    with pytest.raises(ActionError, match="nothing to plan for"):
        plan(model, bare, cost, tool=TOOL, solver=SOLVER, num_knots=3)
    with pytest.raises(ValueError, match=r"start must be \(3, 2\)"):
        plan(model, scene, cost, tool=TOOL, solver=SOLVER, num_knots=3, start=torch.zeros(2, 2))


def test_solvers_of_stable_worldmodel_may_ask_for_the_same_costs(given) -> None:
    model, scene, cost, _ = given
    world_model = CostModel(model, TOOL)
    candidates = 2 * torch.rand(1, 5, 3, 2, generator=torch.Generator().manual_seed(0)).double() - 1
    with pytest.raises(ValueError, match="set_task"):
        world_model.get_cost({}, candidates)
    world_model.set_task(scene, cost)
    costs = world_model.get_cost({}, candidates)
    asked: list[torch.Tensor] = []

    class Asks(RandomShooting):
        def solve(self, evaluate, start, seed):
            asked.append(evaluate(candidates[0]))
            return super().solve(evaluate, start, seed)

    plan(model, scene, cost, tool=TOOL, solver=Asks(2, 1), num_knots=3)
    assert costs.shape == (1, 5) and torch.allclose(costs[0], asked[0])
    assert next(iter(world_model.parameters())).dtype == torch.float64
