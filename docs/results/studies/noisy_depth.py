"""Models trained and evaluated on what depth cameras deliver, beside clean depth.

``python -m docs.results.studies.noisy_depth OUT.json WORK [--model inertial] [--seeds 0,1] [--conditions NAME,...]
[--minutes 10] [--section NAME]``.
For every scene and condition the small data set is generated with a sensor (``WORK/SCENE_CONDITION``), a model is
trained on it (``MODELS``), and its last checkpoint is evaluated on the test clips of the same data set: it sees their
noisy depth, and is judged by their true state and their pictures. What is there already is not made again. Percentages
are of the scene's median depth; cameras are triggered together unless the condition says otherwise.
"""

import argparse
import json
import math
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from vpd_lightning.files import AtomicPath

SCENES = ("mujoco_block", "deformable_collision", "movi_a")
CONDITIONS: dict[str, tuple[str, ...]] = {
    "clean": (),
    "structured_light_0.2": ("sensor=structured_light", "sensor.percent_at_median=0.2"),
    "active_stereo_0.5": ("sensor=active_stereo", "sensor.percent_at_median=0.5"),
    "trigger_15ms": (
        "sensor=structured_light", "sensor.percent_at_median=0.2", "sensor.trigger_offset=0.015",
        "sensor.trigger_steps=5",  # divides the physics steps of a frame in all scenes
    ),
    "poses_5mm": ("sensor=structured_light", "sensor.percent_at_median=0.2", "sensor.pose_offset=0.005"),
}  # fmt: skip
MODELS: dict[str, tuple[str, ...]] = {
    "inertial": ("model=inertial", "budget=minutes"),
    # As docs/notes.md ("What more training would bring") trains it, half as wide.
    "vpd_staged": (
        "model=vpd_staged", "budget=hour", "callbacks=weight_averaging", "pretraining.share=0.3",
        "data.moving_ray_fraction=0.5", "data.moving_ray_margin=4", "data.num_steps=2",
        "data.num_steps_schedule=null", "optimizer.final_share=1.0", "dynamics.hidden_dim=64",
    ),
}  # fmt: skip
# Of a core; inertial's is no more than the demo's training takes (docs/results/demo_released.json).
MINUTES = {"inertial": 10, "vpd_staged": 20}
STEPS = (1, 4, 8, 16, 32)


def figures(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return what one ``metrics.json`` says of moving pixels (decibels) and of centroids (centimetres), by horizon."""

    def at(summary: Mapping[str, Any], scale: float = 1.0) -> dict[str, float | None]:
        values = {step: summary["per_step"][step - 1] for step in STEPS if step <= len(summary["per_step"])}
        return {str(step): None if value is None else scale * value for step, value in values.items()}

    motion = metrics["motion"]
    return {
        "updates": metrics["step"],
        "num_clips": metrics["protocol"]["num_clips"],
        "psnr_moving": metrics["psnr_moving"]["mean"],
        "psnr_moving_references": {name: value["psnr_moving"]["mean"] for name, value in metrics["references"].items()},
        "psnr": metrics["psnr"]["mean"],
        "ssim": metrics["ssim"]["mean"],
        "centroid_error": at(motion["centroid_error"], 100),
        "nothing_moves": at(motion["centroid_error_copy"], 100),
        "best_constant": at(motion["centroid_error_constant"], 100),
        "constant_velocity": at(motion["centroid_error_velocity"], 100),
    }


def means(cells: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the mean of the seeds by scene and depth, and the difference to perfect depth with the same seeds.

    ``psnr_moving_gap`` (decibels), ``centroid_error_4_gap`` (centimetres) and ``centroid_error_4_ratio`` compare the
    means over those seeds which both have. What a cell lacks is left out.
    """
    found: dict[str, Any] = {}
    for key in sorted({key.rpartition("/")[0] for key in cells}, key=_in_order):
        scene, condition = key.split("/")
        seeds = {name.rpartition("/")[2]: cell for name, cell in cells.items() if name.rpartition("/")[0] == key}
        taken = list(seeds.values())
        mean: dict[str, Any] = {"seeds": len(taken), "updates": round(_mean(taken, "updates"))}
        mean["psnr_moving"] = _mean(taken, "psnr_moving")
        mean |= {f"centroid_error_{step}": _mean(taken, "centroid_error", step) for step in ("1", "4", "8", "16")}
        mine = [cell for seed, cell in seeds.items() if f"{scene}/clean/{seed}" in cells]
        perfect = [cells[f"{scene}/clean/{seed}"] for seed in seeds if f"{scene}/clean/{seed}" in cells]
        if perfect and condition != "clean":
            error, known = _mean(mine, "centroid_error", "4"), _mean(perfect, "centroid_error", "4")
            mean["paired_seeds"] = len(perfect)
            mean["psnr_moving_gap"] = _mean(mine, "psnr_moving") - _mean(perfect, "psnr_moving")
            mean |= {"centroid_error_4_gap": error - known, "centroid_error_4_ratio": error / known}
        mean |= {name: _mean(taken, "psnr_moving_references", name) for name in ("copy_last", "train_mean")}
        references = ("best_constant", "constant_velocity", "nothing_moves")
        mean |= {f"{name}_4": _mean(taken, name, "4") for name in references}
        found[key] = {name: value for name, value in mean.items() if not math.isnan(value)}
    return found


def _mean(cells: Sequence[Mapping[str, Any]], *path: str) -> float:
    """Return the mean of what lies there; not a number where a cell has none."""
    values: list[Any] = list(cells)
    for name in path:
        values = [value.get(name) for value in values]
    return fmean(float("nan") if value is None else value for value in values)


def _in_order(key: str) -> tuple[int, int]:
    scene, condition = key.split("/")
    return SCENES.index(scene), list(CONDITIONS).index(condition)


def measured(model: str, minutes: int, scene: str, condition: str, seed: int, work: Path) -> dict[str, Any]:
    """Generate, train and evaluate, as far as that is not done, and return the figures."""
    data = work / f"{scene}_{condition}"
    run = work / "runs" / f"{model}_{minutes}_minutes" / f"{scene}_{condition}_seed{seed}"
    if not (run / "evaluation" / "metrics.json").is_file():
        _call("data", "generate", f"scene={scene}", "preset=small", "seed=0", f"out={data}", *CONDITIONS[condition])
        words = (f"experiment={scene}", *MODELS[model], f"seed={seed}", f"data.folder={data}")
        words += (f"callbacks.time_budget.minutes={minutes}",)
        _call("train", *words, f"run.folder={run}", "evaluate=false", "resume=auto")
        where = (f"ckpt={run}", f"data.folder={data}", f"out={run / 'evaluation'}")
        _call("eval", *where, "num_videos=0", "num_threads=1", "protocol.start_frames=[0]")
    return figures(json.loads((run / "evaluation" / "metrics.json").read_text()))


def _call(command: str, *words: str) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-m", f"vpd_lightning.commands.{command}", *words], check=True, env=environment)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what is missing, and write the figures and their means after every model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--model", choices=list(MODELS), default="inertial")
    parser.add_argument("--scenes", type=lambda text: text.split(","), default=list(SCENES))
    parser.add_argument("--seeds", type=lambda text: [int(word) for word in text.split(",")], default=[0, 1])
    parser.add_argument("--conditions", type=lambda text: text.split(","), default=list(CONDITIONS)[:3])
    parser.add_argument("--minutes", type=int, help="of a core, for a training (else MINUTES)")
    parser.add_argument("--section", help="the part of OUT.json that the figures are put into")
    options = parser.parse_args(arguments)
    minutes = options.minutes or MINUTES[options.model]
    for seed in options.seeds:
        for scene in options.scenes:
            for condition in options.conditions:
                key = f"{scene}/{condition}/seed{seed}"
                if key in _cells(options.out, options.section):
                    continue
                cell = measured(options.model, minutes, scene, condition, seed, options.work)
                # Read anew: another process may have written beside this one.
                cells = dict(sorted({**_cells(options.out, options.section), key: cell}.items()))
                whole = json.loads(options.out.read_text()) if options.out.is_file() else {}
                whole.setdefault("command", "python -m docs.results.studies.noisy_depth")
                part = whole.setdefault(options.section, {}) if options.section else whole
                part.update(cells=cells, means=means(cells))
                with AtomicPath(options.out) as file:
                    file.write_text(json.dumps(whole, indent=1) + "\n")
                print(key, json.dumps(cell), flush=True)
    return 0


def _cells(out: Path, section: str | None) -> dict[str, Any]:
    whole: dict[str, Any] = json.loads(out.read_text()) if out.is_file() else {}
    cells: dict[str, Any] = (whole.get(section, {}) if section else whole).get("cells", {})
    return cells


if __name__ == "__main__":
    raise SystemExit(main())
