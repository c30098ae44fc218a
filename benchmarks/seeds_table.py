"""Print a Markdown table of several evaluations of one experiment, one row per seed, and their mean.

Usage: python -m benchmarks.seeds_table runs/demo/seed*/evaluation/metrics.json
"""

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Metrics = dict[str, Any]


def _better(metrics: Metrics, name: str) -> float:
    return max(reference[name]["mean"] for reference in metrics["references"].values())


def _share_of_constant(step: int) -> Callable[[Metrics], float]:
    return lambda metrics: 100 * metrics["motion"]["centroid_error_over_constant"]["per_step"][step - 1]


COLUMNS: list[tuple[str, Callable[[Metrics], float], str]] = [
    ("PSNR", lambda m: m["psnr"]["mean"], ".2f"),
    ("better reference", lambda m: _better(m, "psnr"), ".2f"),
    ("PSNR moving", lambda m: m["psnr_moving"]["mean"], ".2f"),
    ("better reference", lambda m: _better(m, "psnr_moving"), ".2f"),
    ("SSIM", lambda m: m["ssim"]["mean"], ".3f"),
    ("centroid error, step 4 (cm)", lambda m: 100 * m["motion"]["centroid_error"]["per_step"][3], ".1f"),
    ("of best constant, step 4 (%)", _share_of_constant(4), ".0f"),
    ("of best constant, step 8 (%)", _share_of_constant(8), ".0f"),
]


def table(evaluations: Sequence[Metrics]) -> str:
    """Return the Markdown table; the last row is the mean over the evaluations."""
    rows = [[get(metrics) for _, get, _ in COLUMNS] for metrics in evaluations]
    names = [f"run {number}" for number in range(len(rows))] + ["**mean**"]
    rows.append(list(np.mean(rows, axis=0)))
    lines = ["| | " + " | ".join(name for name, _, _ in COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    for name, row in zip(names, rows, strict=True):
        cells = [format(value, form) for value, (_, _, form) in zip(row, COLUMNS, strict=True)]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table([json.loads(Path(path).read_text()) for path in sys.argv[1:]]))
