"""What each part of the training recipe buys.

``python -m docs.results.studies.recipes FOLDER [--rows NAME,...] [--seeds 0,1]`` trains ``model=inertial`` on MuJoCo
Block for an equal number of updates, once for each row and seed, and measures it on the validation split; ``python -m
docs.results.studies.motion_table FOLDER --evaluation evaluation_validation`` brings the figures together. What is
done already is left as it is, and what was killed goes on. Two runs share two cores (``--beside``).
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

UPDATES = 400
TRAINING = (
    "experiment=mujoco_block", "model=inertial", "budget=minutes", "callbacks.time_budget.minutes=null",
    "evaluate=false", "protocol.split=validation", "resume=auto",
)  # fmt: skip
EVALUATION = ("protocol.split=validation", "protocol.start_frames=[0,6]", "num_videos=0")
RECIPES: dict[str, tuple[str, ...]] = {
    "base": (),
    "pixel": ("loss=pixel", "data.load_future=false"),
    "even_rays": ("data.moving_ray_fraction=0",),
    "no_margin": ("data.moving_ray_margin=0",),
    "average": ("callbacks=weight_averaging",),
    "no_colors": ("color_features=false",),
    "no_octaves": ("renderer.background_frequencies=0",),
    "fast": ("optimizer.lr=6e-3",),
    "slow": ("optimizer.lr=6e-4",),
    "long_clips": ("data.num_steps=8", "data.batch_size=2"),
    "short_clips": ("data.num_steps=2", "data.batch_size=8"),
    "growing_clips": ("data.num_steps_schedule={0.0:2,0.5:4}",),
    "noise": ("scene.location_noise=0.003",),
    "no_warm_up": ("optimizer.warmup_steps=0",),
}


def measure(folder: Path, row: str, seed: int, threads: int) -> str:
    """Train one row with one seed and evaluate it; returns what to print."""
    run = folder / "mujoco_block" / f"{row}_{seed}"
    if (run / "evaluation_validation" / "metrics.json").is_file():
        return f"{row} {seed}: done before"
    words = [*TRAINING, f"trainer.max_steps={UPDATES}", f"seed={seed}", f"run.folder={run}", *RECIPES[row]]
    for command, arguments in (
        ("train", [*words, f"num_threads={threads}"]),
        ("eval", [f"ckpt={run}", *EVALUATION, f"num_threads={threads}"]),
    ):
        log = folder / f"{row}_{seed}_{command}.log"
        with log.open("w") as stream:
            arguments = ["-m", f"vpd_lightning.commands.{command}", *arguments]
            environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
            code = subprocess.call([sys.executable, *arguments], stdout=stream, stderr=stream, env=environment)
        if code != 0:
            return f"{row} {seed}: vpd-{command} ended with {code}, see {log}"
    return f"{row} {seed}: done"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run rows over seeds, the first seed of all rows first."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rows", default=",".join(RECIPES), help="of " + ", ".join(RECIPES))
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--beside", type=int, default=2, help="runs at a time, one thread each")
    options = parser.parse_args(arguments)
    rows, seeds = options.rows.split(","), [int(seed) for seed in options.seeds.split(",")]
    if unknown := set(rows) - set(RECIPES):
        parser.error(f"no such row: {', '.join(sorted(unknown))}; there are {', '.join(RECIPES)}")
    options.folder.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(options.beside) as pool:
        jobs = [pool.submit(measure, options.folder, row, seed, 1) for seed in seeds for row in rows]
        results = []
        for job in jobs:
            results.append(job.result())
            print(results[-1], flush=True)
    return 0 if all("ended with" not in result for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())
