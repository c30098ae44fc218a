"""Whether VPD's bodies move as they should: evaluations of several seeds against what needs no learning.

``python -m docs.results.studies.vpd_motion OUT.json NAME=FOLDER ...``; each folder is one of ``vpd-eval``, with its
``metrics.json`` and ``arrays.npz``. Centroid errors are in centimetres, over all clips, after as many steps;
each is given with the 95 % bootstrap interval over trajectories of the model's error minus the reference's on the same
clips: where it lies below zero, the model is better.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vpd_lightning.evaluation.statistics import summarize
from vpd_lightning.files import AtomicPath

STEPS = (1, 4, 8, 16, 32)
REFERENCES = {"nothing_moves": "copy", "best_constant": "constant", "constant_velocity": "velocity"}


def measured(folder: Path) -> dict[str, Any]:
    """Return what one evaluation says.

    Raises:
        FileNotFoundError: the folder is not that of an evaluation.
    """
    metrics = json.loads((folder / "metrics.json").read_text())
    with np.load(folder / "arrays.npz") as arrays:
        trajectory, num_bootstrap = arrays["trajectory"], metrics["protocol"]["num_bootstrap"]
        errors = {
            name: 100 * arrays["_".join(("motion/centroid_error", *end))]
            for name, end in {"model": (), **{name: (end,) for name, end in REFERENCES.items()}}.items()
        }
        size = arrays["motion/size_ratio"]

    def at(values: Any, step: int) -> dict[str, Any]:
        found = summarize(values[..., step - 1 : step], trajectory, num_bootstrap)
        return {key: found[key] for key in ("mean", "ci95", "count")}

    return {
        "seed": metrics["seed"],
        "checkpoint_sha256": metrics["checkpoint_sha256"],
        "data_sha256": metrics["data_sha256"],
        "updates": metrics["step"],
        "training": metrics["training"],
        "protocol": metrics["protocol"],
        "long_rollout": metrics["long_rollout"],
        "centroid_error": {name: {str(step): at(values, step) for step in STEPS} for name, values in errors.items()},
        "difference": {
            name: {str(step): at(errors["model"] - errors[name], step) for step in STEPS} for name in REFERENCES
        },
        "size_ratio": {str(step): at(size, step) for step in STEPS},
        "chamfer": metrics["chamfer"]["mean"],
        **{
            name: {"model": metrics[name]["mean"], "input_views": metrics[name]["input_views"]}
            | {key: value[name]["mean"] for key, value in metrics["references"].items()}
            | {f"{key}_input_views": value[name]["input_views"] for key, value in metrics["references"].items()}
            for name in ("psnr", "psnr_moving", "ssim")
        },
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Write what the evaluations say."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("evaluations", nargs="+", metavar="NAME=FOLDER")
    options = parser.parse_args(arguments)
    found = {}
    for word in options.evaluations:
        name, _, folder = word.partition("=")
        found[name] = measured(Path(folder))
    with AtomicPath(options.out) as part:
        part.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
