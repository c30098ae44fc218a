"""Several systems, trained over seeds, on several data sets: ``python -m docs.results.studies.motion_table FOLDER``.

``FOLDER`` holds ``EXPERIMENT/SYSTEM_SEED/evaluation/metrics.json``, as ``vpd-train`` with that ``run.folder`` and then
``vpd-eval`` leave them. Each cell is the mean over seeds with the least and the greatest. References are those of the
first seed; they are the same for all. Centroid errors (``step N``) and Chamfer distance are in centimetres; ``size 32``
is a rigid body's size after 32 steps over its first, ``rest`` the share of bodies that come to rest within 5 cm of
their true height, ``seconds`` what an update took by the training's clock. ``--columns`` chooses others than usual.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

Metrics = dict[str, Any]
STEPS = (1, 4, 8, 16, 32)
MIN_AT_REST = 5  # bodies, below which a share says nothing
REFERENCES = {"copy_last": "*last frame*", "train_mean": "*mean image*"}
CENTROIDS = {"constant": "*best constant*", "velocity": "*first velocity kept*"}
COLUMNS = ("updates", "PSNR", "PSNR moving", *(f"step {step}" for step in STEPS), "Chamfer", "size 32", "rest")
FORMS = {
    "updates": ".0f", "seconds": ".2f", "PSNR": ".2f", "PSNR moving": ".2f", "SSIM": ".3f", "size 32": ".2f",
    "rest": ".0%",
}  # fmt: skip


def read_runs(folder: Path, evaluation: str = "evaluation") -> dict[str, dict[str, dict[int, Metrics]]]:
    """Return the metrics by data set, system and seed; ``evaluation`` is the folder's name in each run.

    Raises:
        FileNotFoundError: there are none.
    """
    found: dict[str, dict[str, dict[int, Metrics]]] = defaultdict(lambda: defaultdict(dict))
    for path in sorted(folder.glob(f"*/*/{evaluation}/metrics.json")):
        system, _, seed = path.parents[1].name.rpartition("_")
        found[path.parents[2].name][system][int(seed)] = json.loads(path.read_text())
    if not found:
        raise FileNotFoundError(f"{folder} holds no EXPERIMENT/SYSTEM_SEED/{evaluation}/metrics.json")
    return found


def numbers_of(metrics: Metrics) -> dict[str, float | None]:
    """Return what a table shows of one run; centroid errors and Chamfer distance in centimetres."""
    errors = metrics["motion"]["centroid_error"]["per_step"]
    shown: dict[str, float | None] = {
        "updates": metrics["step"],
        "PSNR": metrics["psnr"]["mean"],
        "PSNR moving": metrics["psnr_moving"]["mean"],
        "Chamfer": 100 * metrics["chamfer"]["mean"],
    }
    sizes = metrics["motion"].get("size_ratio", {}).get("per_step")
    rest = metrics.get("events", {}).get("rest", {})
    shown |= {f"step {step}": 100 * errors[step - 1] for step in STEPS}
    spent = metrics.get("training", {}).get("seconds")
    return shown | {
        "seconds": None if spent is None or not metrics["step"] else spent / metrics["step"],
        "SSIM": metrics.get("ssim", {}).get("mean"),
        "size 32": sizes[31] if sizes else None,
        "rest": rest.get("share_within_5_cm") if rest.get("count", 0) >= MIN_AT_REST else None,
    }


def references_of(metrics: Metrics) -> dict[str, dict[str, float | None]]:
    """Return the figures of what needs no learning."""
    rows: dict[str, dict[str, float | None]] = {}
    for key, name in REFERENCES.items():
        values = metrics["references"][key]
        rows[name] = {"PSNR": values["psnr"]["mean"], "PSNR moving": values["psnr_moving"]["mean"]}
        rows[name] |= {"SSIM": values["ssim"]["mean"]} if "ssim" in values else {}
    for key, name in CENTROIDS.items():
        errors = metrics["motion"][f"centroid_error_{key}"]["per_step"]
        rows[name] = {f"step {step}": 100 * errors[step - 1] for step in STEPS}
    return rows


def table(runs: dict[str, dict[str, dict[int, Metrics]]], columns: Sequence[str] = COLUMNS) -> str:
    """Return the Markdown table."""
    lines = ["| " + " | ".join(["data set", "system", *columns]) + " |", "|---|---|" + "---:|" * len(columns)]
    for experiment, systems in runs.items():
        for system, seeds in systems.items():
            each = [numbers_of(metrics) for metrics in seeds.values()]
            cells = [_spread([numbers[name] for numbers in each], name) for name in columns]
            lines.append(f"| {experiment} | {system} | " + " | ".join(cells) + " |")
        first = next(iter(next(iter(systems.values())).values()))
        for name, numbers in references_of(first).items():
            cells = [_spread([numbers[key]], key) if key in numbers else "" for key in columns]
            lines.append(f"| | {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _spread(values: Sequence[float | None], name: str) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    form = FORMS.get(name, ".1f")
    mean = format(float(np.mean(known)), form)
    return mean if len(known) == 1 else f"{mean} [{format(min(known), form)}, {format(max(known), form)}]"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and, with ``--out``, write its numbers as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--evaluation", default="evaluation", help="evaluation_validation for the validation split")
    parser.add_argument("--out", type=Path, help="JSON file of the numbers of every run")
    names = sorted({*COLUMNS, *FORMS})
    parser.add_argument("--columns", nargs="+", default=COLUMNS, choices=names, metavar="COLUMN", help=", ".join(names))
    options = parser.parse_args(arguments)
    runs = read_runs(options.folder, options.evaluation)
    print(table(runs, options.columns))
    if options.out:
        content = {
            experiment: {
                system: {seed: numbers_of(metrics) for seed, metrics in seeds.items()}
                for system, seeds in systems.items()
            }
            | {"references": references_of(next(iter(next(iter(systems.values())).values())))}
            for experiment, systems in runs.items()
        }
        options.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
