"""How often planning solves seeded tasks of pushing: with a model, by chance, with the truth, and by doing nothing.

``python -m docs.results.studies.planning OUT.json NAME=CKPT [--kinds ... --tasks 50 --systems ...]`` runs each system
in closed loop against MuJoCo: ``model`` (cross-entropy method), ``random`` (random shooting with the same number of
candidates), ``truth`` (the same planner and candidates on the simulator itself, the ceiling) and ``nothing``. Worlds
and tasks depend on the seed alone (seeds from ``FIRST_SEED`` on, which no data set has; choices were made on seeds from
1000 on). For ``place`` those worlds count whose first body stays where it is put, a box or a cylinder: of ten that roll
the simulator itself, by the same planner, left four or five where they should be. Results are added to OUT.json task by
task, so a stopped run goes on and several may share a file (with the same settings, or they are refused); success rates
come with 95 % Wilson intervals.
"""

import argparse
import fcntl
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch

from data_gen.pushing.settings import PushingSettings
from data_gen.settings import load_settings
from docs.results.studies.changed_dynamics import add_option, change_dynamics
from vpd_lightning.files import AtomicPath
from vpd_lightning.planning.closed_loop import Loop, run_with_model, run_with_truth, run_without_action
from vpd_lightning.planning.solvers import CrossEntropy, RandomShooting
from vpd_lightning.planning.tasks import KINDS, draw_task
from vpd_lightning.planning.tool import PlanarTool

FIRST_SEED = 2000
NUM_ITERATIONS, NUM_ELITES, SPREAD = 2, 8, 0.7
NUM_KNOTS, HOLD, NUM_EXECUTED, NUM_DECISIONS = 6, 4, 2, 10
MAX_SPEED = 0.016  # metres a frame: 0.4 m/s
_SETTINGS = {
    "num_iterations": NUM_ITERATIONS,
    "num_elites": NUM_ELITES,
    "spread": SPREAD,
    "num_knots": NUM_KNOTS,
    "hold": HOLD,
    "num_executed": NUM_EXECUTED,
    "num_decisions": NUM_DECISIONS,
    "max_speed": MAX_SPEED,
}
_Z = 1.96


def loop_of(solver_name: str, settings: PushingSettings, num_samples: int) -> Loop:
    """Return how is planned: ``random`` draws as many candidates as the cross-entropy method does."""
    limit = np.asarray(settings.table.half_size) + settings.pusher.overhang
    solver = (
        RandomShooting(num_samples, NUM_ITERATIONS)
        if solver_name == "random"
        else CrossEntropy(num_samples, NUM_ITERATIONS, NUM_ELITES, SPREAD)
    )
    tool = PlanarTool(MAX_SPEED, (-limit).tolist(), limit.tolist(), HOLD, settings.pusher_lag)
    return Loop(tool, solver, NUM_KNOTS, NUM_EXECUTED, NUM_DECISIONS)


def seeds_of(kind: str, count: int, settings: PushingSettings) -> list[int]:
    """Return the seeds of the first ``count`` worlds for tasks of a kind."""
    from data_gen.pushing.world import PushingWorld

    found: list[int] = []
    seed = FIRST_SEED
    while len(found) < count:
        if kind != "place" or not PushingWorld(settings, seed, None).bodies[0].rolls:
            found.append(seed)
        seed += 1
    return found


def run(system: str, kind: str, seed: int, settings: PushingSettings, model: Any, num_samples: int) -> dict[str, Any]:
    """Run one task with one system."""
    from data_gen.pushing.world import PushingWorld

    world = PushingWorld(settings, seed, "egl" if system in ("model", "random") else None)
    half_size = np.asarray(settings.table.half_size)
    task = draw_task(kind, world.places, half_size, np.random.default_rng([seed, KINDS.index(kind)]))  # type: ignore[arg-type]
    loop = loop_of(system, settings, num_samples)
    try:
        if system == "nothing":
            episode = run_without_action(world, task, loop)
        elif system == "truth":
            episode = run_with_truth(world, task, loop, seed)
        else:
            episode = run_with_model(model.simulator, world, task, loop, model.input_views, seed)
    finally:
        world.close()
    final = episode.places[-1][0]
    return {
        "solved": episode.solved,
        "seconds_per_decision": float(np.mean(episode.seconds)) if episode.seconds else 0.0,
        "distance": float(np.hypot(*(final[:2] - task.goal))),
        "height": float(final[2]),
        "num_bodies": len(world.places),
    }


def rate(solved: list[bool]) -> list[float]:
    """Return the success rate with its Wilson interval."""
    n, p = len(solved), float(np.mean(solved))
    middle, width = p + _Z**2 / (2 * n), _Z * np.sqrt(p * (1 - p) / n + _Z**2 / (4 * n**2))
    scale = 1 + _Z**2 / n
    return [p, float((middle - width) / scale), float((middle + width) / scale)]


def main() -> None:
    """Run what is missing and print success rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("model", help="NAME=CKPT")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS))
    parser.add_argument("--systems", nargs="+", default=["nothing", "truth", "model", "random"])
    parser.add_argument("--tasks", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--samples", type=int, default=64, help="candidates of each of the two iterations")
    add_option(parser)
    options = parser.parse_args()
    torch.set_num_threads(1)
    os.environ.setdefault("MUJOCO_GL", "egl")
    from vpd_lightning.loading import load_model

    name, ckpt = options.model.split("=", 1)
    model = load_model(ckpt)
    changes = change_dynamics(model, options.dynamics)  # what makes it faster
    settings = load_settings(PushingSettings, "pushing", "small", {})
    used = {**_SETTINGS, "num_samples": options.samples, "dynamics of model": changes}
    kept = _read(options.out, name)
    if kept.get("settings", used) != used:
        raise SystemExit(f"{options.out} was made with {kept['settings']}, not {used}: name another file.")
    seeds = {kind: seeds_of(kind, options.tasks, settings) for kind in options.kinds}
    for number in range(options.first, options.tasks):
        for kind in options.kinds:
            for system in options.systems:
                key = f"{system}/{kind}/{seeds[kind][number]}"
                if key not in _read(options.out, name)["tasks"]:
                    found = run(system, kind, seeds[kind][number], settings, model, options.samples)
                    _add(options.out, name, key, found, used)
                    print(key, found, flush=True)
    print_rates(json.loads(options.out.read_text())["tasks"])


def _read(path: Path, name: str) -> dict[str, Any]:
    """Return what was found so far."""
    found: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {"model": name, "tasks": {}}
    return found


def _add(path: Path, name: str, key: str, found: dict[str, Any], used: dict[str, Any]) -> None:
    """Add one result to what was found so far, by this run and by others."""
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        result = _read(path, name)
        result["tasks"][key] = found
        result |= {"rates": rates(result["tasks"]), "settings": used}
        with AtomicPath(path) as file:
            file.write_text(json.dumps(result, indent=1, sort_keys=True) + "\n")


def rates(tasks: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the success rate, number of tasks and seconds per decision of each system and kind."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for key, found in tasks.items():
        groups.setdefault(key.rsplit("/", 1)[0], []).append(found)
    return {
        key: {
            "rate": rate([one["solved"] for one in group]),
            "tasks": len(group),
            "seconds_per_decision": float(np.mean([one["seconds_per_decision"] for one in group])),
        }
        for key, group in sorted(groups.items())
    }


def print_rates(tasks: dict[str, dict[str, Any]]) -> None:
    """Print a line for each system and kind."""
    for key, found in rates(tasks).items():
        p, low, high = found["rate"]
        print(f"{key:22} {p:.2f} [{low:.2f}, {high:.2f}] of {found['tasks']}, {found['seconds_per_decision']:.1f} s")


if __name__ == "__main__":
    main()
