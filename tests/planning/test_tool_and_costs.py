"""A tool within its limits, and costs of particles whose places are known. Metres."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from vpd_lightning.planning.bodies import Body
from vpd_lightning.planning.costs import BehindBody, ChamferToCloud, NearTool, OutOfRegion, Sum, TargetPlace, TargetPose
from vpd_lightning.planning.tasks import KINDS, PLACE_TOLERANCE, ROOM_RADIUS, Task, draw_task
from vpd_lightning.planning.tool import PlanarTool
from vpd_lightning.types import Driven, Particles

TOOL = PlanarTool(0.02, low=(-0.3, -0.2), high=(0.3, 0.2), hold=3)
HALF_SIZE = np.array([0.35, 0.3])


def driven(place: tuple[float, float, float] = (0.1, 0.0, 0.05)) -> Driven:
    points = torch.tensor([[[0.01, 0, 0], [-0.01, 0, 0], [0, 0.01, 0], [0, -0.01, 0]]]) + torch.tensor(place)
    return Driven.from_arrays(points, torch.tensor([0, 0, 1.0]).expand_as(points))


def test_an_action_is_a_share_of_the_largest_speed_and_is_held() -> None:
    motion = TOOL.motion(driven(), torch.tensor([[[1.0, 0.0], [0.0, -0.5]]]))
    assert motion.positions.shape == (1, 6, 4, 3)
    steps = torch.diff(torch.cat([driven().positions, motion.positions[0]]), dim=0)
    assert torch.allclose(steps[:3], torch.tensor([0.02, 0, 0]).expand(3, 4, 3), atol=1e-6)
    assert torch.allclose(steps[3:], torch.tensor([0, -0.01, 0]).expand(3, 4, 3), atol=1e-6)


def test_neither_speed_nor_place_pass_their_limits() -> None:
    path = TOOL.path(torch.tensor([0.1, 0.0]), torch.tensor([[[1.0, 1.0]] * 8]))[0]
    assert torch.diff(path, dim=0).norm(dim=-1).max() < 0.02 + 1e-6
    assert path[:, 0].max() <= 0.3 + 1e-6 and path[:, 1].max() == pytest.approx(0.2)


def test_from_outside_the_limits_it_may_come_back() -> None:
    out = torch.tensor([0.5, 0.0])
    away, back = (TOOL.path(out, torch.tensor([[[sign, 0.0]]]))[0, -1, 0].item() for sign in (1.0, -1.0))
    assert away == pytest.approx(0.5) and back == pytest.approx(0.44)


def test_a_tool_that_lags_is_where_it_was_commanded_to_be_some_of_a_step_ago() -> None:
    slow, commanded = replace(TOOL, lag=0.25), torch.tensor([0.105, 0.0])
    motion = slow.motion(driven(), torch.tensor([[[1.0, 0.0]]]), commanded)
    middles = motion.positions[0].mean(dim=1)[:, 0]
    assert torch.allclose(middles, 0.105 + torch.tensor([0.015, 0.035, 0.055]), atol=1e-6)
    with pytest.raises(ValueError, match="lag must lie"):
        replace(TOOL, lag=2.0)


@pytest.mark.parametrize("change", [{"max_speed": 0}, {"hold": 0}, {"low": (0.4, 0.0)}], ids=str)
def test_limits_that_make_no_sense_are_refused(change: dict) -> None:
    with pytest.raises(ValueError, match="max_speed must be positive"):
        replace(TOOL, **change)


CHOSEN = torch.tensor([True, True, False])
BODY = Body(CHOSEN, torch.tensor([[-0.01, 0, 0], [0.01, 0, 0]]), torch.zeros(3), radius=0.03)


def states(*middles: tuple[float, float]) -> list[Particles]:
    """One candidate whose first two particles lie 2 cm apart about a middle, step by step."""
    made = []
    for x, y in middles:
        positions = torch.tensor([[[x - 0.01, y, 0.0], [x + 0.01, y, 0.0], [9.0, 9.0, 9.0]]])
        made.append(Particles(positions, torch.zeros(1, 3, 1), driven=driven()))
    return made


def test_costs_are_distances_at_the_end_and_a_little_of_the_way() -> None:
    place = TargetPlace(BODY, torch.tensor([0.0, 0.0]), axes=(0, 1))
    assert place(states((0.3, 0.0), (0.1, 0.0))).item() == pytest.approx(0.1 + 0.1 * 0.2, abs=1e-6)
    pose = TargetPose(CHOSEN, torch.tensor([[0.09, 0, 0], [0.11, 0, 0]]))
    assert pose(states((0.1, 0.0))).item() == pytest.approx(0, abs=1e-6)
    assert pose(states((0.2, 0.0))).item() == pytest.approx(0.11, abs=1e-6)
    swapped = TargetPose(CHOSEN, torch.tensor([[0.11, 0, 0], [0.09, 0, 0]]))  # turned by half a turn
    assert swapped(states((0.1, 0.0))).item() == pytest.approx(0.022, abs=1e-6)


def test_a_region_costs_as_much_as_the_shortest_way_out() -> None:
    bodies, middle = [BODY], torch.zeros(2)
    disc = OutOfRegion(bodies, middle, torch.tensor([0.1]))
    assert disc(states((0.04, 0.03))).item() == pytest.approx(0.05 * 1.1, abs=1e-6)
    assert disc(states((0.2, 0.0))).item() == 0
    table = OutOfRegion(bodies, middle, torch.tensor([0.35, 0.3]), margin=0.02)
    assert table(states((0.3, 0.0))).item() == pytest.approx(0.07 * 1.1, abs=1e-6)
    assert table(states((0.36, 0.0))).item() == pytest.approx(0.01 * 1.1, abs=1e-6)


def test_a_cloud_costs_its_chamfer_distance() -> None:
    cloud = torch.tensor([[0.09, 0.0, 0.0], [0.11, 0.0, 0.0]])
    cost = ChamferToCloud(CHOSEN, cloud)
    assert cost(states((0.1, 0.0))).item() == pytest.approx(0, abs=1e-6)
    assert cost(states((0.1, 0.05))).item() == pytest.approx(0.05, abs=1e-6)


def test_what_rolls_on_is_not_there_yet() -> None:
    place = TargetPlace(BODY, torch.tensor([0.0, 0.0]), axes=(0, 1), stopping=4)
    assert place(states((0.02, 0.0), (0.0, 0.0))).item() == pytest.approx(4 * 0.02 + 0.1 * 0.01, abs=1e-6)
    assert place(states((0.0, 0.0), (0.0, 0.0))).item() == pytest.approx(0, abs=1e-6)


def test_the_tool_is_led_to_the_far_side_of_a_body() -> None:
    behind = BehindBody(BODY, torch.tensor([-1.0, 0.0]), 0.5)  # the tool's radius is 1 cm, and it is at x = 0.1
    assert behind(states((0.06, 0.0))).item() == pytest.approx(0, abs=1e-6)
    assert behind(states((0.14, 0.0))).item() == pytest.approx(0.5 * 0.08, abs=1e-6)


def test_the_tool_is_led_to_the_body_and_costs_add_up() -> None:
    near = NearTool(BODY, 0.5)
    assert near(states((0.5, 0.0), (0.3, 0.0), (0.4, 0.0))).item() == pytest.approx(0.5 * 0.2, abs=1e-6)
    place = TargetPlace(BODY, torch.tensor([0.0, 0.0]), axes=(0, 1))
    both = Sum([near, place])(states((0.3, 0.0)))
    assert both.item() == pytest.approx(0.1 + 0.33, abs=1e-6)


def test_a_cost_about_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="none is chosen"):
        TargetPose(~torch.ones(3, dtype=torch.bool), torch.zeros(0, 3))(states((0.0, 0.0)))
    with pytest.raises(ValueError, match="none is chosen"):
        Body.of(states((0.0, 0.0))[0], ~torch.ones(3, dtype=torch.bool))
    bare = [replace(state, driven=None) for state in states((0.0, 0.0))]
    with pytest.raises(ValueError, match="nothing that is driven"):
        NearTool(BODY, 1.0)(bare)


def test_doing_nothing_solves_no_task_and_the_goal_does() -> None:
    for seed in range(20):
        draw = np.random.default_rng(seed)
        places = np.array([[0.05, -0.05, 0.03], [0.2, 0.2, 0.03]])
        for kind in KINDS:
            task = draw_task(kind, places, HALF_SIZE, draw)
            assert not task.is_solved(places)
            there = places.copy()
            there[0] = {"place": [*task.goal, 0.03], "off_table": [0.5, 0, -0.25], "make_room": [-0.2, 0.1, 0.03]}[kind]
            assert task.is_solved(there)
    fallen = Task("place", np.zeros(2), HALF_SIZE)
    assert not fallen.is_solved(np.array([[0, 0, -0.2]])), "on the floor below the goal it is not there"
    assert fallen.is_solved(np.array([[0.9 * PLACE_TOLERANCE, 0, 0.03]]))
    other = Task("make_room", np.zeros(2), HALF_SIZE)
    assert not other.is_solved(np.array([[0.3, 0, 0.03], [0.9 * ROOM_RADIUS, 0, 0.03]])), "another body is in the way"


@pytest.mark.parametrize("kind", KINDS)
def test_the_cost_of_a_task_falls_towards_its_goal(kind: str) -> None:
    task = Task(kind, np.array([0.2, 0.0]), HALF_SIZE)  # type: ignore[arg-type]
    toward = {"place": (0.15, 0.05), "off_table": (0.05, 0.34), "make_room": (0.28, 0.0)}[kind]
    start = {"place": (0.05, 0.0), "off_table": (0.05, 0.2), "make_room": (0.21, 0.0)}[kind]
    cost = task.cost([BODY])
    assert cost(states(toward)).item() < cost(states(start)).item()
