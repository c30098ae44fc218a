"""What sleeping particles save, and what they change: ``python -m benchmarks.sleeping --ckpt CHECKPOINT...``.

Each clip is rolled out by a checkpoint as it is and with its dynamics wrapped in ``SleepingDynamics``. Static drift is
that of the particles outside the true boxes (grown by ``MARGIN``): how far each of them ever is from where it was
observed. The centroid error is that of the particles of the true bodies, a mean over the steps that the recording has.
``step_costs`` measures one step of an untrained graph network by the share of particles that is awake.
"""

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from benchmarks.measuring import Result, Row, interleaved, row, seconds_now
from benchmarks.results_files import default_folder, write
from vpd_lightning.config import build, compose
from vpd_lightning.config.sleeping import with_sleeping
from vpd_lightning.data.clip import Clip, read_clip
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.sleeping import SleepingDynamics
from vpd_lightning.evaluation.motion import clip_motion, trajectory_of
from vpd_lightning.evaluation.prediction import encode_clip
from vpd_lightning.loading import load_model
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.simulator import Scene, Simulator
from vpd_lightning.types import Particles

MARGIN = 0.02  # metres
START_FRAME = 2


@dataclass(frozen=True)
class Rollout:
    """One clip rolled out one way; metres, and seconds for all steps. Shares are means over the steps."""

    seconds: float
    awake_share: float
    active_share: float
    static_drift_median: float
    static_drift_max: float
    centroid_error: float
    size_ratio_end: float


def roll(simulator: Simulator, clip: Clip, scene: Scene, num_steps: int, repeats: int) -> Rollout:
    """Roll out one clip and judge it; the time is the shortest of the repeats."""
    device = scene.current.positions.device
    seconds, states = float("inf"), []
    for _ in range(repeats):
        start = seconds_now(device)
        states = simulator.rollout(scene, num_steps)
        seconds = min(seconds, seconds_now(device) - start)
    positions = trajectory_of(scene.current, states)
    motion, bodies = clip_motion(clip, positions, MARGIN, None)
    static = positions[:, ~bodies.any(0)]
    drift = (static[1:] - static[0]).norm(dim=-1).amax(0)
    errors = motion["centroid_error"]
    awake, active = _shares(simulator.dynamics, scene, num_steps)
    return Rollout(
        seconds=seconds,
        awake_share=awake,
        active_share=active,
        static_drift_median=float(drift.median()),
        static_drift_max=float(drift.max()),
        centroid_error=float(errors[errors.isfinite()].mean()),
        size_ratio_end=float(motion["size_ratio"][:, -1].mean()),
    )


@torch.no_grad()
def _shares(dynamics: AbstractDynamics, scene: Scene, num_steps: int) -> tuple[float, float]:
    """Roll out once more, looking at who was awake and who was computed in each step."""
    if not isinstance(dynamics, SleepingDynamics):
        return 1.0, 1.0
    keys, previous, current = RandomKeys.fixed(1), scene.previous, scene.current
    awake, active = [], []
    memory = dynamics.initialize(previous, current, keys)
    for step in range(num_steps):
        following, memory = dynamics(previous, current, memory, keys, step)
        previous, current = current, following
        awake.append(dynamics.last_awake_share)
        active.append(dynamics.last_active_share)
    return fmean(awake), fmean(active)


def compare(
    checkpoint: Path,
    split: str,
    num_clips: int,
    steps: Sequence[int],
    variants: Sequence[Mapping[str, Any]] = ({},),
    data: Path | None = None,
    repeats: int = 1,
) -> dict[str, Rollout]:
    """Return means over the clips, by ``"plain, 8 steps"`` and ``"{settings}, 8 steps"`` for each variant."""
    loaded = load_model(checkpoint)
    paths = load_manifest(data or Path(loaded.config["data"]["folder"])).split(split)[:num_clips]
    clips = [read_clip(path, index, START_FRAME, 1) for index, path in enumerate(paths)]
    simulator, plain = loaded.simulator, loaded.simulator.dynamics
    scenes = [encode_clip(simulator, clip, loaded.input_views) for clip in clips]
    systems: dict[str, AbstractDynamics] = {"plain": plain}
    for settings in variants:
        section = with_sleeping(loaded.config, settings)["dynamics"]
        built = build(section, AbstractDynamics, "dynamics")
        built.load_state_dict(plain.state_dict())
        systems[str(dict(settings))] = built.eval()
    results: dict[str, list[Rollout]] = {f"{name}, {count} steps": [] for count in steps for name in systems}
    for clip, scene in zip(clips, scenes, strict=True):
        for count in steps:
            for name, dynamics in systems.items():
                simulator.dynamics = dynamics
                results[f"{name}, {count} steps"].append(roll(simulator, clip, scene, count, repeats))
    simulator.dynamics = plain
    return {name: _mean(rollouts) for name, rollouts in results.items()}


def _mean(rollouts: Sequence[Rollout]) -> Rollout:
    return Rollout(*(fmean(getattr(one, item.name) for one in rollouts) for item in fields(Rollout)))


def as_rows(name: str, results: Mapping[str, Rollout]) -> list[Row]:
    """Return rows for ``vpd-bench``: the error is how much the centroid error grew, in metres."""
    rows = []
    for label, one in results.items():
        plain = results[f"plain, {label.rpartition(', ')[2]}"]
        if one is plain:
            continue
        note = (
            f"{1 - one.awake_share:.0%} asleep, {1 - one.active_share:.0%} not computed; centroid error "
            f"{one.centroid_error:.4f} m (plain {plain.centroid_error:.4f}); static drift median "
            f"{one.static_drift_median:.4f} m (plain {plain.static_drift_median:.4f}), largest "
            f"{one.static_drift_max:.4f} m (plain {plain.static_drift_max:.4f})"
        )
        error = one.centroid_error - plain.centroid_error
        label = label.removeprefix("{}, ")  # settings as they are in conf/
        rows.append(
            row(f"{name}: sleeping {label}", [one.seconds], f"{name}: plain", [plain.seconds], error, note=note)
        )
    return rows


@torch.no_grad()
def step_costs(
    num_particles: int,
    shares: Sequence[float],
    repeats: int,
    words: Sequence[str] = ("dynamics=sleeping", "dynamics.dynamics.num_abstract_nodes=256"),
) -> list[Row]:
    """Time one step of a floor (2 m wide, the paper's radii) of which one side is awake, against a step of all."""
    config = compose("train", [*words, "scene=mujoco", "data.folder=none", "run.folder=none"])
    dynamics: SleepingDynamics = build(config["dynamics"], AbstractDynamics, "dynamics").eval()
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(1, num_particles, 3, generator=generator) * torch.tensor([2.0, 2.0, 0.1])
    floor = Particles(positions, torch.rand(1, num_particles, config["feature_dim"], generator=generator))
    keys = RandomKeys.fixed(1)
    start = dynamics.initialize(floor, floor, keys)
    distance = positions[..., 0]
    steps = {"all": lambda: dynamics.dynamics(floor, floor, None, keys, 1)}
    for share in shares:
        memory = replace(start, asleep=distance > torch.quantile(distance, share) if share else distance > -1)
        steps[f"{share:.0%}"] = lambda memory=memory: dynamics(floor, floor, memory, keys, 1)
    seconds = interleaved(steps, repeats, positions.device)
    name = f"{num_particles} particles"
    return [row(f"{name}, {share:.0%} awake", seconds[f"{share:.0%}"], name, seconds["all"]) for share in shares]


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ckpt", nargs="*", type=Path, default=[])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--split", default="validation")
    parser.add_argument("--clips", type=int, default=16)
    parser.add_argument("--steps", nargs="+", type=int, default=[8, 100])
    parser.add_argument("--rest-speeds", nargs="*", type=float, default=[])
    parser.add_argument("--step-costs", nargs="*", type=int, default=[], help="numbers of particles")
    parser.add_argument("--out", type=Path, default=default_folder(), help="folder of sleeping_cpu.json")
    options = parser.parse_args()
    torch.set_num_threads(1)  # so that the clock counts this process alone
    start = time.perf_counter()
    variants = [{"rest_speed": speed} for speed in options.rest_speeds] or [{}]
    rows: list[Row] = []
    for path in options.ckpt:
        results = compare(path, options.split, options.clips, options.steps, variants, options.data)
        for name, one in results.items():
            values = "  ".join(f"{item.name} {getattr(one, item.name):.4f}" for item in fields(Rollout))
            print(f"{path}: {name}: {values}", flush=True)
        rows += as_rows("/".join(path.parts[-4:-2]), results)
    for count in options.step_costs:
        rows += step_costs(count, (1.0, 0.5, 0.2, 0.05, 0.0), 3)
    note = f"{options.split} split, {options.clips} clips; error: metres by which the centroid error grew"
    print(write("sleeping", torch.device("cpu"), Result(rows, {"clips": note}), options.out))
    print(f"{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
