"""``vpd-plan``: plan what a pusher does with a trained simulator, in closed loop with the simulated scene."""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from vpd_lightning.commands.report_errors import run_command
from vpd_lightning.errors import ConfigError


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the console command; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    return run_command(lambda: _run(words))


def _run(words: list[str]) -> int:
    from vpd_lightning.commands.hydra_application import configure

    config = configure("plan", words)
    if config is not None:
        _plan(config)
    return 0


def _plan(config: Mapping[str, Any]) -> None:
    import numpy as np

    from data_gen.pushing.settings import PushingSettings
    from data_gen.settings import load_settings
    from vpd_lightning.files import OutputFolder, choose_folder
    from vpd_lightning.planning.closed_loop import run_with_model, run_with_truth, run_without_action
    from vpd_lightning.planning.report import write_episode
    from vpd_lightning.planning.tasks import draw_task
    from vpd_lightning.release.results_folder import beside_checkpoint
    from vpd_lightning.runs.one_recording import load_particle_simulator
    from vpd_lightning.runs.threads import set_threads

    settings = load_settings(PushingSettings, "pushing", config["preset"], {})
    loop = _loop(config, settings)
    set_threads(config["num_threads"])
    model = load_particle_simulator(config)
    if config["system"] == "model" and not model.simulator.takes_actions:
        raise ConfigError(
            f"{model.path} was trained without actions, so it cannot plan any.\n"
            "Train one: vpd-train experiment=pushing model=inertial encoder=unet_moving."
        )
    _set_contact(model.simulator.dynamics, config["contact"])
    backend = _backend(config["backend"]) if config["system"] == "model" else None
    from data_gen.pushing.world import PushingWorld  # after MUJOCO_GL is set

    folder = choose_folder(config["out"], beside_checkpoint(model.path, "plan"))
    world = PushingWorld(settings, config["seed"], backend)
    generator = np.random.default_rng([config["seed"], ("place", "off_table", "make_room").index(config["task"])])
    task = draw_task(config["task"], world.places, np.asarray(settings.table.half_size), generator)
    try:
        with OutputFolder(folder) as partial:
            if config["system"] == "model":
                episode = run_with_model(
                    model.simulator, world, task, loop, model.input_views, config["seed"], progress=_print_decision
                )
            elif config["system"] == "truth":
                episode = run_with_truth(world, task, loop, config["seed"])
            else:
                episode = run_without_action(world, task, loop)
            details = {
                "checkpoint": str(model.path),
                "checkpoint_sha256": model.sha256,
                **{
                    name: config[name]
                    for name in ("task", "seed", "preset", "system", "solver", "contact", "max_speed")
                },
            }
            write_episode(partial, model.simulator, world, task, episode, details, config["fps"])
    finally:
        world.close()
    words = "solved" if episode.solved else "not solved"
    seconds = f", {np.mean(episode.seconds):.1f} s a decision" if episode.seconds else ""
    print(f"{config['task']}, world {config['seed']}, by {config['system']}: {words}{seconds}")
    print(folder)


def _set_contact(dynamics: Any, contact: Mapping[str, int | None]) -> None:
    """Have a dynamics that resolves contact do so as coarsely as is asked for; others have no such settings."""
    for name, value in contact.items():
        if value is not None and value < 1:
            raise ConfigError(f"contact.{name}={value} is out of range.\nAllowed: 1 or more, or null: as trained.")
        if value is not None and hasattr(dynamics, name):
            setattr(dynamics, name, value)


def _print_decision(number: int, total: int, cost: float) -> None:
    print(f"decision {number + 1}/{total}: cost of the plan {cost:.3f} m", file=sys.stderr, flush=True)


def _loop(config: Mapping[str, Any], settings: Any) -> Any:
    import numpy as np

    from vpd_lightning.planning.closed_loop import Loop
    from vpd_lightning.planning.solvers import CrossEntropy, PathIntegral, RandomShooting, Solver
    from vpd_lightning.planning.tasks import KINDS
    from vpd_lightning.planning.tool import PlanarTool

    for name, allowed in (("task", KINDS), ("system", ("model", "truth", "nothing"))):
        if config[name] not in allowed:
            raise ConfigError(f"{name}={config[name]} is unknown.\nAllowed: {', '.join(allowed)}.")
    if config["data"]["folder"] is not None:
        raise ConfigError("data.folder has no effect here: vpd-plan makes its own world, by seed.\nRemove it.")
    for name in ("num_knots", "hold", "num_executed", "num_decisions"):
        if config[name] < 1:
            raise ConfigError(f"{name}={config[name]} is out of range.\nAllowed: 1 or more.")
    if config["num_executed"] > config["num_knots"]:
        raise ConfigError(
            f"num_executed={config['num_executed']} actions cannot be taken of a plan of {config['num_knots']}.\n"
            "Set it to num_knots or fewer."
        )
    if not config["max_speed"] > 0 or not config["fps"] > 0:
        raise ConfigError(
            f"max_speed={config['max_speed']} and fps={config['fps']} must be above 0.\n"
            "Give metres and frames a second."
        )
    chosen = config["solver"]
    size = (chosen["num_samples"], chosen["num_iterations"])
    if min(size) < 1:
        raise ConfigError(f"solver.num_samples and num_iterations are {size}.\nAllowed: 1 or more.")
    solvers: dict[str, Callable[[], Solver]] = {
        "cem": lambda: CrossEntropy(*size, chosen["num_elites"], chosen["spread"]),
        "mppi": lambda: PathIntegral(*size, chosen["spread"], chosen["temperature"]),
        "random": lambda: RandomShooting(*size),
    }
    if chosen["name"] not in solvers:
        raise ConfigError(f"solver.name={chosen['name']} is unknown.\nAllowed: {', '.join(solvers)}.")
    try:
        solver = solvers[chosen["name"]]()
    except ValueError as error:
        raise ConfigError(f"{error}.\nCorrect the solver's settings.") from error
    limit = (np.asarray(settings.table.half_size) + settings.pusher.overhang).tolist()
    speed = config["max_speed"] * settings.frame_time
    tool = PlanarTool(speed, [-x for x in limit], limit, config["hold"], settings.pusher_lag)
    return Loop(tool, solver, config["num_knots"], config["num_executed"], config["num_decisions"])


def _backend(wanted: str) -> str:
    if wanted not in ("auto", "egl", "osmesa"):
        raise ConfigError(f"backend={wanted} is unknown.\nAllowed: auto, egl, osmesa.")
    from data_gen.gl_backend import choose_backend

    backend = choose_backend(wanted)
    os.environ["MUJOCO_GL"] = backend
    return backend


if __name__ == "__main__":
    sys.exit(main())
