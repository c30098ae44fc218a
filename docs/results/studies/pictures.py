"""How good predicted pictures are, by horizon, beside what needs no model.

Usage: ``python -m docs.results.studies.pictures OUT.json NAME=FOLDER ...``; each folder is one of ``vpd-eval``, best
made with ``protocol.draw_references=true``. Of every score it keeps the mean over images with its 95 % interval and the
mean after some steps, for the model, for both references, and for other motions drawn by the same renderer.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vpd_lightning.evaluation.summary import horizons
from vpd_lightning.files import AtomicPath
from vpd_lightning.metrics.registry import scores

MODEL = "prediction"


def measured(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return what one ``metrics.json`` says of pictures and of where bodies are (centimetres)."""
    steps = horizons(metrics["protocol"]["num_steps"])
    sources = {MODEL: metrics, **metrics["references"], **(metrics.get("drawn") or {})}

    def by_step(summary: Mapping[str, Any], scale: float = 1.0) -> dict[str, float | None]:
        values = {step: summary["per_step"][step - 1] for step in steps}
        return {str(step): None if value is None else scale * value for step, value in values.items()}

    pictures = {
        source: {
            info.name: {key: found[info.name][key] for key in ("mean", "ci95", "input_views", "other_views")}
            | {"per_step": by_step(found[info.name])}
            for info in scores()
            if info.name in found
        }
        for source, found in sources.items()
    }
    motion = metrics["motion"] or {}
    centroid = {
        name: by_step(motion[key], 100)
        for name, key in {
            MODEL: "centroid_error",
            "nothing_moves": "centroid_error_copy",
            "best_constant": "centroid_error_constant",
            "constant_velocity": "centroid_error_velocity",
        }.items()
        if key in motion
    }
    return {
        **{key: metrics[key] for key in ("system", "experiment", "seed", "step", "num_parameters")},
        **{key: metrics[key] for key in ("checkpoint_sha256", "data_sha256", "training", "protocol", "seconds")},
        "pictures": pictures,
        "reconstruction": metrics["reconstruction"],
        "centroid_error": centroid,
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
        found[name] = measured(json.loads((Path(folder) / "metrics.json").read_text()))
    with AtomicPath(options.out) as part:
        part.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
