"""What the action is worth: motion of pushed bodies with the true action, another recording's, none, and without any.

``python -m docs.results.studies.actions OUT.json DATA NAME=CKPT[,CKPT...] ... [--split test --starts 0 6 12]``
measures every system, trained once or with several seeds (whose errors are averaged body by body), on bodies whose
true centre moves by more than ``MOVED`` within 16 steps, and apart (``stay``) on those of them that do not fall by
``FALLEN`` meanwhile. A model that takes actions is given the true motion
(``true``), that of another clip, carried to where the pusher is (``shuffled``), and none (``still``: the pusher
stays). Errors are those of ``vpd-eval``: of the centre in centimetres, of the orientation in degrees, by horizon;
beside them what needs no model (a constant displacement means nothing where bodies are pushed any way).
``psnr_moving`` is of pictures of the first camera (dB, over moving pixels), beside the last input frame (``copy``) and
the mean of the training pictures. Intervals: 2,000 resamples of trajectories.

``--ratios NAME=WITH/WITHOUT`` divides the mean error of one system of the file, given the true action, by that of
another one, given none: the same bodies in both. DATA holds the split that is measured and, as ``train``, the
recordings of which the mean picture is.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from docs.results.studies.changed_dynamics import change_dynamics, parser_of
from vpd_lightning.data.clip import Clip, read_clip
from vpd_lightning.evaluation.images import as_float, moving_pixels
from vpd_lightning.evaluation.motion import clip_motion, trajectory_of
from vpd_lightning.evaluation.prediction import encode_clip, render_steps, roll_out_clip, takes_actions
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.evaluation.references import training_mean
from vpd_lightning.files import AtomicPath
from vpd_lightning.loading import LoadedModel, load_model
from vpd_lightning.metrics.psnr import psnr_of_moving_pixels
from vpd_lightning.metrics.true_images import TrueImages
from vpd_lightning.runs.evaluation_run import training_of
from vpd_lightning.types import Driven, Particles

STEPS = (1, 2, 4, 8, 16, 32)
MOVED = 0.01  # metres
FALLEN = 0.05  # metres
TOUCHED_WITHIN = 16  # steps
REFERENCES = {"nothing moves": "copy", "true velocity": "velocity"}
CAMERA = 0
_NUM_RESAMPLES = 2000


def variants(model: LoadedModel, clip: Clip, other: Clip) -> dict[str, Clip]:
    """Return the clip with the actions that the model is given."""
    if clip.driven is None or other.driven is None or not takes_actions(model.simulator):
        return {"none": clip}
    here, there = clip.context_driven, other.context_driven
    assert here is not None and there is not None and clip.target_driven is not None
    now, moved = here.positions[-1:], other.target_driven
    assert moved is not None
    elsewhere = now + (moved.positions - there.positions[-1:])
    still = now.expand_as(moved.positions)
    return {
        "true": clip,
        "shuffled": _with_positions(clip, here, elsewhere),
        "still": _with_positions(clip, here, still),
    }


def _with_positions(clip: Clip, context: Driven, positions: torch.Tensor) -> Clip:
    assert clip.driven is not None
    return replace(clip, driven=replace(clip.driven, positions=torch.cat([context.positions, positions])))


def pictures(model: LoadedModel, clip: Clip, states: Sequence[Particles]) -> torch.Tensor:
    """Return what one camera would see after ``STEPS`` (step, 1, height, width, 3), colours in [0, 1]."""
    at = [step - 1 for step in STEPS]
    cameras = clip.target_cameras[at][:, [CAMERA]]
    return render_steps(model.simulator, [states[step] for step in at], cameras).float().cpu().nan_to_num(0.0)


def true_pictures(model: LoadedModel, clip: Clip) -> TrueImages:
    """Return what it did see, and which pixels moved."""
    protocol = Protocol(**model.config["protocol"])
    at = [step - 1 for step in STEPS]
    colors, moving = as_float(clip.target_rgb)[at], moving_pixels(clip, protocol)[at]
    return TrueImages(colors[:, [CAMERA]], moving[:, [CAMERA]], protocol.min_moving_pixels)


@dataclass(frozen=True)
class Errors:
    """Errors of one model: by body (rows) and by clip (scores), each with the number of its trajectory."""

    bodies: dict[str, NDArray[np.float64]]
    trajectory: NDArray[np.int64]
    stays: NDArray[np.bool_]
    scores: dict[str, NDArray[np.float64]]
    clip_of: NDArray[np.int64]


def errors(model: LoadedModel, data: Path, split: str, starts: Sequence[int]) -> Errors:
    """Return the errors of one model with each kind of action."""
    margin = model.config["protocol"]["body_margin"]
    mean = training_mean(sorted((data / "train").glob("*.h5")))[None, [CAMERA]]
    scores: dict[str, list[NDArray[np.float64]]] = {}
    clip_of: list[int] = []
    files = sorted((data / split).glob("*.h5"))
    rows: dict[str, list[NDArray[np.float64]]] = {}
    trajectory: list[int] = []
    stays: list[NDArray[np.bool_]] = []
    with torch.no_grad():
        for number, path in enumerate(files):
            for start in starts:
                clip = read_clip(path, number, start, max(STEPS))
                other = read_clip(files[(number + 1) % len(files)], number, start, max(STEPS))
                moved = clip.poses(TOUCHED_WITHIN)[..., :3]
                moved = moved - moved[:1]
                touched = moved.norm(dim=-1).amax(dim=0) > MOVED
                if not bool(touched.any()):
                    continue
                scene = encode_clip(model.simulator, clip, model.input_views)
                seen, clip_of = true_pictures(model, clip), [*clip_of, number]
                shown_as = {"copy": as_float(clip.rgb[-1:])[:, [CAMERA]], "mean image": mean}
                for name, shown in variants(model, clip, other).items():
                    states = roll_out_clip(model.simulator, scene, shown, max(STEPS))
                    motion, _ = clip_motion(clip, trajectory_of(scene.current, states), margin, None)
                    keep = touched[: len(motion["centroid_error"])]
                    for metric, values in motion.items():
                        rows.setdefault(f"{name}/{metric}", []).append(values[keep].numpy())
                    shown_as[name] = pictures(model, clip, states)
                for name, colors in shown_as.items():
                    scores.setdefault(name, []).append(psnr_of_moving_pixels(colors, seen)["psnr_moving"].mT.numpy())
                trajectory += [number] * int(keep.sum())
                stays.append((moved[..., 2].amin(dim=0) > -FALLEN)[: len(keep)][keep].numpy())
    return Errors(
        {name: np.concatenate(values) for name, values in rows.items()}, np.array(trajectory), np.concatenate(stays),
        {name: np.concatenate(values) for name, values in scores.items()}, np.array(clip_of),
    )  # fmt: skip


def measured(models: Sequence[LoadedModel], data: Path, split: str, starts: Sequence[int]) -> dict[str, Any]:
    """Return the errors of one system, averaged over its models (one for each seed)."""
    each = [errors(model, data, split, starts) for model in models]
    first = each[0]
    bodies = {name: np.mean([one.bodies[name] for one in each], axis=0) for name in first.bodies}
    staying = {name: values[first.stays] for name, values in bodies.items()}
    found = {**_summary(bodies, first.trajectory), "sums": _sums(bodies, first.trajectory)}
    found["stay"] = {
        **_summary(staying, first.trajectory[first.stays]), "sums": _sums(staying, first.trajectory[first.stays])
    }  # fmt: skip
    found["psnr_moving"] = {
        name: _means(np.mean([one.scores[name] for one in each], axis=0), first.clip_of)
        for name in sorted(first.scores)
    }
    found["seeds"] = [
        {
            "centroid_error": _centres(_summary(one.bodies, one.trajectory)),
            "updates": model.step,
            "training": None if model.checkpoint is None else training_of(model.checkpoint, model.path),
        }
        for model, one in zip(models, each, strict=True)
    ]
    parameters = sum(values.numel() for values in models[0].simulator.parameters())
    return {**found, "parameters": parameters, "starts": list(starts)}


def _summary(rows: dict[str, NDArray[np.float64]], trajectory: NDArray[np.int64]) -> dict[str, Any]:
    at = [step - 1 for step in STEPS]
    found: dict[str, Any] = {"bodies": len(trajectory), "trajectories": len(np.unique(trajectory))}
    for name in sorted({key.split("/")[0] for key in rows}):
        part = {}
        for metric, scale in (("centroid_error", 100.0), ("orientation_error", 1.0), ("size_ratio", 1.0)):
            if f"{name}/{metric}" in rows:
                part[metric] = _means(scale * rows[f"{name}/{metric}"][:, at], trajectory)
        found[name] = part
    first = sorted({key.split("/")[0] for key in rows})[0]
    found["references"] = {
        title: _means(100 * rows[f"{first}/centroid_error_{end}"][:, at], trajectory)
        for title, end in REFERENCES.items()
        if f"{first}/centroid_error_{end}" in rows
    }
    return found


def _centres(found: dict[str, Any]) -> dict[str, Any]:
    """Return the centre's error of each kind of action."""
    parts = {kind: part for kind, part in found.items() if isinstance(part, dict)}
    return {kind: part["centroid_error"] for kind, part in parts.items() if "centroid_error" in part}


def _sums(rows: dict[str, NDArray[np.float64]], trajectory: NDArray[np.int64]) -> dict[str, Any]:
    """Return the sum of the centre's errors (cm) of each trajectory's bodies, by kind of action and step."""
    numbers = np.unique(trajectory)
    return {
        name.split("/")[0]: {
            str(step): [float(100 * values[trajectory == n, step - 1].sum()) for n in numbers] for step in STEPS
        }
        for name, values in sorted(rows.items())
        if name.endswith("/centroid_error")
    }


def ratio(above: dict[str, Any], below: dict[str, Any]) -> dict[str, list[float]]:
    """Return error with the action divided by error without, by step: [ratio, low, high]; trajectories resampled."""
    draw = np.random.default_rng(0)
    found = {}
    for step in map(str, STEPS):
        upper, lower = np.array(above["sums"]["true"][step]), np.array(below["sums"]["none"][step])
        chosen = draw.integers(len(upper), size=(_NUM_RESAMPLES, len(upper)))
        low, high = np.percentile(upper[chosen].sum(axis=1) / lower[chosen].sum(axis=1), [2.5, 97.5])
        found[step] = [float(upper.sum() / lower.sum()), float(low), float(high)]
    return found


def _means(values: NDArray[np.float64], trajectory: NDArray[np.int64]) -> dict[str, list[float]]:
    """Return mean and 95 % interval by step: [mean, low, high]; resampled by trajectory."""
    draw = np.random.default_rng(0)
    numbers = np.unique(trajectory)
    sums = np.stack([np.nansum(values[trajectory == n], axis=0) for n in numbers])
    counts = np.stack([np.isfinite(values[trajectory == n]).sum(axis=0) for n in numbers])
    chosen = draw.integers(len(numbers), size=(_NUM_RESAMPLES, len(numbers)))
    with np.errstate(invalid="ignore", divide="ignore"):
        means = sums[chosen].sum(axis=1) / counts[chosen].sum(axis=1)
        mean = sums.sum(axis=0) / counts.sum(axis=0)
    low, high = np.nanpercentile(means, [2.5, 97.5], axis=0)
    return {str(step): [float(mean[i]), float(low[i]), float(high[i])] for i, step in enumerate(STEPS)}


def main() -> None:
    """Measure the models and print a table of each."""
    parser = parser_of(__doc__, "*")
    parser.add_argument("--ratios", nargs="*", default=[], help="NAME=WITH/WITHOUT")
    options = parser.parse_args()
    torch.set_num_threads(1)
    result = json.loads(options.out.read_text()) if options.out.is_file() else {}
    for words in options.models:
        name, paths = words.split("=", 1)
        models = [load_model(path) for path in paths.split(",")]
        changes = [change_dynamics(model, options.dynamics) for model in models][0]
        result[name] = {**measured(models, options.data, options.split, options.starts), "dynamics": changes}
        _write(options.out, result)
        print_table(name, result[name])
    for words in options.ratios:
        name, parts = words.split("=", 1)
        above, below = parts.split("/", 1)
        both = result[above], result[below]
        result[name] = {"all": ratio(*both), "stay": ratio(*(one["stay"] for one in both))}
        _write(options.out, result)
        for bodies, found in result[name].items():
            print(name, bodies, " ".join(f"{step}: {found[str(step)][0]:.2f}" for step in STEPS))


def _write(out: Path, result: dict[str, Any]) -> None:
    with AtomicPath(out) as path:
        path.write_text(json.dumps(result, indent=1) + "\n")


def print_table(name: str, found: dict[str, Any]) -> None:
    """Print the centre's error of each kind of action."""
    print(f"{name}: {found['bodies']} bodies of {found['trajectories']} trajectories; cm after {STEPS} steps")
    for kind, row in {**_centres(found), **found["references"]}.items():
        print(f"  {kind:14}", " ".join(f"{row[str(step)][0]:6.2f}" for step in STEPS))
    print("  moving PSNR of its pictures, dB")
    for kind, row in found["psnr_moving"].items():
        print(f"  {kind:14}", " ".join(f"{row[str(step)][0]:6.2f}" for step in STEPS))


if __name__ == "__main__":
    main()
