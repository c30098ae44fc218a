"""How VPD's motion improves with training: checkpoints of one training after another.

``python -m docs.results.studies.motion_curve OUT.json DATA NAME=CKPT,CKPT,... ...`` measures every checkpoint on the
validation split: mean centroid error (centimetres) after each of ``STEPS`` steps beside the references of the same
clips, correlation and slope of the predicted on the true displacement of bodies after one step (deviations from their
mean over all bodies, which is what tells whether each body's own motion is seen), and the size of bodies. Updates and
seconds of the training are those in the checkpoint. What OUT.json holds already is not measured again.

``motion_law.py`` fits laws to these points and draws them.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from docs.results.studies.vpd_motion import REFERENCES
from vpd_lightning.data.clip import read_clip
from vpd_lightning.evaluation.bodies import find_bodies
from vpd_lightning.evaluation.motion import clip_motion, trajectory_of
from vpd_lightning.evaluation.prediction import encode_clip
from vpd_lightning.evaluation.references import median_displacements
from vpd_lightning.files import AtomicPath
from vpd_lightning.loading import LoadedModel, load_model

STEPS = (1, 2, 4, 8, 16, 32)


def measured(model: LoadedModel, data: Path, split: str, start_frames: Sequence[int]) -> dict[str, Any]:
    """Return the errors of one model on the clips of a split."""
    margin = model.config["protocol"]["body_margin"]
    constants = median_displacements(sorted((data / "train").glob("*.h5")), start_frames, max(STEPS))
    errors: dict[str, list[NDArray[np.float64]]] = {}
    moved: list[NDArray[np.float64]] = []
    for number, path in enumerate(sorted((data / split).glob("*.h5"))):
        for start in start_frames:
            clip = read_clip(path, number, start, max(STEPS))
            with torch.no_grad():
                scene = encode_clip(model.simulator, clip, model.input_views)
                positions = trajectory_of(scene.current, model.simulator.rollout(scene, max(STEPS)))
            motion, _ = clip_motion(clip, positions, margin, constants.get(start))
            for name in ("centroid_error", "size_ratio", *(f"centroid_error_{end}" for end in REFERENCES.values())):
                errors.setdefault(name, []).append(motion[name].numpy())
            for body in find_bodies(clip, positions[0], margin, 1):
                if bool(body.mask.any()):
                    predicted = (positions[1] - positions[0])[body.mask].mean(dim=0)
                    moved.append(np.stack([predicted.numpy(), (body.true[1] - body.true[0]).mean(dim=0).numpy()]))
    at = [step - 1 for step in STEPS]

    def row(name: str, scale: float) -> dict[str, float | None]:
        values = np.concatenate(errors[name])[:, at]
        known = [column[~np.isnan(column)] for column in values.T]  # soft bodies, for example, have no size
        return {
            str(step): float(scale * column.mean()) if len(column) else None
            for step, column in zip(STEPS, known, strict=True)
        }

    return {
        "centroid_error_cm": {
            "model": row("centroid_error", 100),
            **{name: row(f"centroid_error_{end}", 100) for name, end in REFERENCES.items()},
        },
        "size_ratio": row("size_ratio", 1),
        "first_step": first_step(np.stack(moved)),
        "clips": sum(map(len, errors["centroid_error"])),
    }


def first_step(moved: NDArray[np.float64]) -> dict[str, float]:
    """Compare predicted with true displacements (``body 2 3``, metres): correlation, slope, mean fall (centimetres)."""
    means = moved.mean(axis=0)
    predicted, true = (moved - means).transpose(1, 0, 2)
    product = float((predicted * true).sum())
    own, theirs = float(np.square(predicted).sum()), float(np.square(true).sum())
    return {
        "correlation": product / (own * theirs) ** 0.5 if own and theirs else 0.0,
        "slope": product / theirs if theirs else 0.0,
        "mean_fall_cm": -100 * float(means[0, 2]),
        "true_mean_fall_cm": -100 * float(means[1, 2]),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what is not measured yet, one checkpoint after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("trainings", nargs="+", metavar="NAME=CKPT,CKPT,...")
    parser.add_argument("--split", default="validation", choices=("train", "validation"))
    parser.add_argument("--start-frames", default="0,6")
    options = parser.parse_args(arguments)
    starts = [int(word) for word in options.start_frames.split(",")]
    setting = {"split": options.split, "start_frames": starts}
    found = json.loads(options.out.read_text()) if options.out.exists() else {"setting": setting, "trainings": {}}
    if found["setting"] != setting:
        parser.error(f"{options.out} was measured with {found['setting']}; name another file")
    for word in options.trainings:
        name, _, paths = word.partition("=")
        training = found["trainings"].setdefault(name, {"points": {}})
        for path in paths.split(","):
            model = load_model(path)
            if model.sha256 in training["points"]:
                continue
            time = ((model.checkpoint or {}).get("callbacks") or {}).get("TimeBudget") or {}
            point = {
                "updates": model.step,
                "clips_per_update": model.config["data"]["batch_size"],
                "parameters_of_dynamics": sum(weight.numel() for weight in model.simulator.dynamics.parameters()),
                "seconds": time.get("seconds"),
                "seconds_before": time.get("seconds_before"),
            }
            point |= measured(model, options.data, options.split, starts)
            training["points"][model.sha256] = point
            print(name, point, flush=True)
            _write(options.out, found)
    return 0


def _write(out: Path, found: dict[str, Any]) -> None:
    with AtomicPath(out) as part:
        part.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    raise SystemExit(main())
