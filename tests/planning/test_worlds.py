"""The world of pushing, its Gymnasium environment, and planning with the truth in closed loop. No pictures but one."""

from typing import Any

import numpy as np
import pytest

from data_gen.pushing.settings import PushingSettings
from data_gen.pushing.world import PushingWorld
from data_gen.settings import load_settings
from vpd_lightning.errors import ConfigError
from vpd_lightning.planning.closed_loop import Loop, run_with_truth, run_without_action
from vpd_lightning.planning.solvers import CrossEntropy
from vpd_lightning.planning.tasks import Task, draw_task
from vpd_lightning.planning.tool import PlanarTool


@pytest.fixture(scope="module")
def settings() -> PushingSettings:
    return load_settings(PushingSettings, "pushing", "tiny", {"bodies.count_max": 1})


def test_the_pusher_goes_where_it_is_commanded_and_no_faster(settings: PushingSettings) -> None:
    world = PushingWorld(settings, 3, None)
    begin = world.pusher[:2]
    far = begin + np.array([-0.5, 0.0])
    world.advance(np.repeat(far[None], 5, axis=0))
    went = np.hypot(*(world.command - begin))
    assert went == pytest.approx(5 * settings.pusher.speed[1] * settings.frame_time, rel=1e-6)
    assert np.hypot(*(world.pusher[:2] - world.command)) < 0.02  # it follows 20 ms behind
    world.advance(np.repeat(np.array([[9.0, 9.0]]), 60, axis=0))
    assert (np.abs(world.command) <= world.limit + 1e-9).all()


def test_the_same_seed_is_the_same_world_and_a_copy_goes_its_own_way(settings: PushingSettings) -> None:
    worlds = [PushingWorld(settings, 5, None) for _ in range(2)]
    goal = worlds[0].places[0, :2]
    for world in worlds:
        world.advance(np.repeat(goal[None], 30, axis=0))
    np.testing.assert_array_equal(worlds[0].poses, worlds[1].poses)
    before = worlds[0].poses
    trial = worlds[0].copy()
    trial.advance(np.repeat(trial.command[None] + 0.3, 20, axis=0))
    np.testing.assert_array_equal(worlds[0].poses, before)
    assert trial.frame == worlds[0].frame + 20
    with pytest.raises(ValueError, match="draws no pictures"):
        trial.observe()


def loop(num_decisions: int) -> Loop:
    tool = PlanarTool(0.016, low=(-0.4, -0.35), high=(0.4, 0.35), hold=4)
    return Loop(tool, CrossEntropy(16, 2, 4, 0.7), num_knots=6, num_executed=3, num_decisions=num_decisions)


def test_planning_with_the_truth_pushes_a_body_towards_its_goal(settings: PushingSettings) -> None:
    world = PushingWorld(settings, 8, None)
    place = world.places[0, :2]
    away = place - world.pusher[:2]
    goal = place + 0.08 * away / np.hypot(*away)  # straight on, behind the body
    task = Task("place", goal, np.asarray(settings.table.half_size))
    episode = run_with_truth(world, task, loop(8))
    assert len(episode.seconds) <= len(episode.costs) == 8 and len(episode.places) == 9
    assert task.distance(episode.places[-1]) < 0.6 * task.distance(episode.places[0])
    assert episode.solved == task.is_solved(world.places)


def test_what_seems_solved_is_left_alone_and_nothing_is_planned(settings: PushingSettings) -> None:
    world = PushingWorld(settings, 8, None)
    task = Task("place", world.places[0, :2], np.asarray(settings.table.half_size))
    command = world.command
    episode = run_with_truth(world, task, loop(3))
    assert episode.solved and not episode.seconds and len(episode.costs) == 3
    np.testing.assert_array_equal(world.command, command)


@pytest.mark.parametrize(("kind", "near", "far"), [("place", 0.005, 0.02), ("make_room", 0.13, 0.11)])
def test_a_task_seems_solved_with_a_margin_only(kind: Any, near: float, far: float) -> None:
    task = Task(kind, np.zeros(2), np.array([0.35, 0.3]))
    at = [np.array([[away, 0.0, 0.03]]) for away in (near, far)]
    assert task.seems_solved(at[0]) and task.is_solved(at[1]) and not task.seems_solved(at[1])
    fallen = np.array([[0.4, 0.0, -0.2]])
    assert not Task("place", fallen[0, :2], task.half_size).seems_solved(fallen)
    assert Task("off_table", np.zeros(2), task.half_size).seems_solved(fallen)


def test_doing_nothing_changes_nothing(settings: PushingSettings) -> None:
    world = PushingWorld(settings, 8, None)
    before = world.places
    task = draw_task("off_table", before, np.asarray(settings.table.half_size), np.random.default_rng(0))
    episode = run_without_action(world, task, loop(2))
    assert not episode.solved and np.abs(world.places - before).max() < 0.01
    assert world.frame == 1 + 2 * 3 * 4


def test_the_environment_follows_the_rules_of_gymnasium() -> None:
    from gymnasium.utils.env_checker import check_env

    from vpd_lightning.planning.environment import PushingEnvironment

    environment = PushingEnvironment("off_table", preset="tiny", num_frames=5, renderer=None)
    try:
        check_env(environment, skip_render_check=True)
        seen, info = environment.reset(seed=4)
        assert set(seen) == {"goal", "pusher"} and not info["is_solved"]
        total = 0.0
        for frame in range(5):
            seen, reward, solved, over, info = environment.step(np.array([1.0, 0.0], np.float32))
            total += reward
            assert over == (frame == 4) and not solved
        places = info["places"]
        assert total == pytest.approx(
            environment.task.distance(environment_places(4)) - environment.task.distance(places), abs=1e-6
        )
    finally:
        environment.close()
    with pytest.raises(ConfigError, match="task=juggle is unknown"):
        PushingEnvironment("juggle", renderer=None)
    with pytest.raises(RuntimeError, match="call reset"):
        PushingEnvironment("place", renderer=None).step(np.zeros(2, np.float32))


def environment_places(seed: int) -> np.ndarray:
    return PushingWorld(load_settings(PushingSettings, "pushing", "tiny", {}), seed, None).places
