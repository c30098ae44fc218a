"""Observe, plan, act, observe: a planner in front of a world, simulated or real."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.planning.bodies import Body, find_bodies
from vpd_lightning.planning.plan import Plan, plan
from vpd_lightning.planning.solvers import Solution, Solver
from vpd_lightning.planning.tasks import Task
from vpd_lightning.planning.tool import PlanarTool
from vpd_lightning.simulator import Scene, Simulator
from vpd_lightning.types import Cameras, Driven, Particles

Progress = Callable[[int, int, float], None]


@runtime_checkable
class Moment(Protocol):
    """What cameras see at a moment, and where the pusher's middle is (3,)."""

    @property
    def rgb(self) -> NDArray[np.uint8]: ...  # (view, height, width, 3)
    @property
    def depth(self) -> NDArray[np.float32]: ...  # (view, height, width), m
    @property
    def pusher(self) -> NDArray[np.float64]: ...


@runtime_checkable
class World(Protocol):
    """What is acted on: a simulation, or a robot and its cameras."""

    def observe(self) -> Moment: ...
    def cameras(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]: ...
    def pusher_surface(self, pusher: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]: ...
    def advance(self, goals: NDArray[np.float64]) -> None: ...


@runtime_checkable
class TrueWorld(World, Protocol):
    """A simulation that knows its bodies and can be tried out."""

    @property
    def places(self) -> NDArray[np.float64]: ...
    @property
    def reaches(self) -> NDArray[np.float64]: ...
    @property
    def pusher(self) -> NDArray[np.float64]: ...
    @property
    def command(self) -> NDArray[np.float64]: ...
    def copy(self) -> "TrueWorld": ...


@dataclass
class Episode:
    """What happened: whether the task was solved, seconds for each decision, and what was seen and planned."""

    solved: bool = False
    seconds: list[float] = field(default_factory=list)
    costs: list[float] = field(default_factory=list)
    moments: list[Moment] = field(default_factory=list)
    plans: list[Plan | None] = field(default_factory=list)
    places: list[NDArray[np.float64]] = field(default_factory=list)
    num_steps: int = 0  # frames from one decision to the next


@dataclass(frozen=True)
class Loop:
    """How often is planned, and for how long: ``num_knots`` actions ahead, of which ``num_executed`` are taken."""

    tool: PlanarTool
    solver: Solver
    num_knots: int
    num_executed: int
    num_decisions: int

    def frames(self, actions: Tensor, start: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the places to command, one for each frame, of the actions that are taken."""
        first = torch.from_numpy(start).to(actions)
        return self.tool.path(first, actions[None, : self.num_executed])[0].double().numpy()


def run_with_model(
    simulator: Simulator,
    world: TrueWorld,
    task: Task,
    loop: Loop,
    input_views: Sequence[int],
    seed: int = 0,
    progress: Progress | None = None,
) -> Episode:
    """Solve a task by planning with a trained simulator from what the cameras see.

    The task names its bodies by where they are at first (a person would click on them); from then on each is the
    cluster of particles nearest to where it was predicted to be. Where the task seems solved, nothing is planned and
    the tool stays until the next look. ``progress`` is called with the number of each
    decision, how many there are and the cost of its plan.
    """
    episode, start = Episode(num_steps=loop.num_executed * loop.tool.hold), None
    expected = torch.from_numpy(world.places)
    before = world.observe()
    world.advance(world.command[None])
    for decision in range(loop.num_decisions):
        now = world.observe()
        began = time.perf_counter()
        scene = _encoded(simulator, world, before, now, input_views)
        bodies = find_bodies(scene.current, expected)
        expected = torch.stack([body.middle for body in bodies]).cpu()
        if task.seems_solved(expected.numpy()):
            start = None
            _note(episode, world, now, None, 0.0)
            before = _act(world, np.repeat(world.command[None], episode.num_steps, axis=0))
            continue
        found = plan(
            simulator,
            scene,
            task.cost(bodies),
            tool=loop.tool,
            solver=loop.solver,
            num_knots=loop.num_knots,
            start=start,
            seed=seed + decision,
            commanded=torch.from_numpy(world.command),
        )
        episode.seconds.append(time.perf_counter() - began)
        start = found.later(loop.num_executed)
        expected = torch.cat([body.middles(found.states[episode.num_steps - 1 :][:1])[:, 0] for body in bodies]).cpu()
        _note(episode, world, now, found, found.cost)
        if progress is not None:
            progress(decision, loop.num_decisions, found.cost)
        before = _act(world, loop.frames(found.actions, world.command))
    episode.moments.append(world.observe())
    episode.plans.append(None)
    return _judged(episode, world, task)


def run_with_truth(world: TrueWorld, task: Task, loop: Loop, seed: int = 0) -> Episode:
    """Solve a task by planning with the world itself: the ceiling of what the same planner can reach.

    As with a model, the tool stays while the task seems solved.
    """
    episode, start = Episode(), torch.zeros(loop.num_knots, 2)
    world.advance(world.command[None])
    for decision in range(loop.num_decisions):
        if task.seems_solved(world.places):
            start = torch.zeros(loop.num_knots, 2)
            _note(episode, world, None, None, 0.0)
            world.advance(np.repeat(world.command[None], loop.num_executed * loop.tool.hold, axis=0))
            continue
        began = time.perf_counter()
        cost = task.cost(_true_bodies(world))

        def evaluate(candidates: Tensor) -> Tensor:
            return cost(_tried(world, loop.tool.path(torch.from_numpy(world.command).float(), candidates)))  # noqa: B023

        found: Solution = loop.solver.solve(evaluate, start, seed + decision)
        episode.seconds.append(time.perf_counter() - began)
        start = torch.cat([found.actions[loop.num_executed :], torch.zeros(loop.num_executed, 2)])
        _note(episode, world, None, None, found.cost)
        world.advance(loop.frames(found.actions, world.command))
    return _judged(episode, world, task)


def run_without_action(world: TrueWorld, task: Task, loop: Loop) -> Episode:
    """Do nothing for as long."""
    episode = Episode()
    world.advance(np.repeat(world.command[None], 1 + loop.num_decisions * loop.num_executed * loop.tool.hold, axis=0))
    return _judged(episode, world, task)


def _act(world: World, goals: NDArray[np.float64]) -> Moment:
    """Command a place for each frame; returns what is seen one frame before the last."""
    world.advance(goals[:-1])
    before = world.observe()
    world.advance(goals[-1:])
    return before


def _note(episode: Episode, world: TrueWorld, moment: Moment | None, found: Plan | None, cost: float) -> None:
    episode.costs.append(cost)
    episode.places.append(world.places)
    episode.plans.append(found)
    if moment is not None:
        episode.moments.append(moment)


def _judged(episode: Episode, world: TrueWorld, task: Task) -> Episode:
    episode.places.append(world.places)
    episode.solved = task.is_solved(world.places)
    return episode


def _encoded(simulator: Simulator, world: World, before: Moment, now: Moment, views: Sequence[int]) -> Scene:
    chosen = list(views)
    height, width = now.depth.shape[-2:]
    cameras = Cameras.from_arrays(*world.cameras(), height, width)[chosen]
    surfaces = [world.pusher_surface(moment.pusher) for moment in (before, now)]
    driven = Driven.from_arrays(*(np.stack(parts) for parts in zip(*surfaces, strict=True)))
    rgb, depth = (np.stack([getattr(moment, name)[chosen] for moment in (before, now)]) for name in ("rgb", "depth"))
    return simulator.encode(rgb, depth, cameras, driven=driven)


def _true_bodies(world: TrueWorld) -> list[Body]:
    """Return the bodies of ``_tried``: each is one particle."""
    places = torch.from_numpy(world.places).float()
    numbers = torch.arange(len(places))
    return [
        Body(numbers == number, place[None], place, float(reach))
        for number, (place, reach) in enumerate(zip(places, world.reaches, strict=True))
    ]


def _tried(world: TrueWorld, paths: Tensor) -> list[Particles]:
    """Return what the world does with each path, as particles: one for each body."""
    steps: list[list[NDArray[np.float64]]] = []
    pushers: list[list[NDArray[np.float64]]] = []
    for path in paths.double().numpy():
        trial = world.copy()
        steps.append([])
        pushers.append([])
        for goal in path:
            trial.advance(goal[None])
            steps[-1].append(trial.places)
            pushers[-1].append(trial.pusher)
    places, tools = (torch.from_numpy(np.array(part)).float() for part in (steps, pushers))
    surface = torch.from_numpy(world.pusher_surface(np.zeros(3))[0]).float()
    up = torch.tensor([0.0, 0.0, 1.0]).expand(len(places), len(surface), 3)
    part = torch.zeros(len(places), len(surface), dtype=torch.int64)
    return [
        Particles(
            positions=places[:, step],
            features=torch.zeros_like(places[:, step, :, :1]),
            driven=Driven(tools[:, step, None] + surface, up, part),
        )
        for step in range(places.shape[1])
    ]
