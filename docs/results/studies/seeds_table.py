"""Print a Markdown table of several evaluations of one experiment, one row per seed, and their mean.

Usage: python -m docs.results.studies.seeds_table runs/demo/seed*/evaluation/metrics.json
"""

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Metrics = dict[str, Any]
Cell = float | str | None
MISSING = "-"


def _better(metrics: Metrics, name: str) -> Cell:
    known = [reference[name]["mean"] for reference in metrics["references"].values()]
    return max((value for value in known if value is not None), default=None)


def _motion(name: str, step: int) -> Callable[[Metrics], Cell]:
    """A motion metric at a step, times 100: centimetres, or per cent."""

    def get(metrics: Metrics) -> Cell:
        values = metrics["motion"][name]["per_step"] if metrics["motion"] else []
        return _hundredfold(values[step - 1]) if step <= len(values) else None

    return get


def _long(metrics: Metrics, group: str, name: str) -> float | None:
    return metrics["long_rollout"][group][name] if metrics["long_rollout"] else None


def _hundredfold(value: float | None) -> float | None:
    return None if value is None else 100 * value


def _is_finite(metrics: Metrics) -> Cell:
    long = metrics["long_rollout"]
    return None if long is None else "yes" if long["finite"] else "NO"


def _size_range(metrics: Metrics) -> Cell:
    low, high = _long(metrics, "size_ratio", "min"), _long(metrics, "size_ratio", "max")
    return None if low is None or high is None else f"{low:.2f} to {high:.2f}"


# What stands above the column, what stands in it, and the format of a number there.
COLUMNS: list[tuple[str, Callable[[Metrics], Cell], str]] = [
    ("PSNR", lambda m: m["psnr"]["mean"], ".2f"),
    ("better reference", lambda m: _better(m, "psnr"), ".2f"),
    ("PSNR moving", lambda m: m["psnr_moving"]["mean"], ".2f"),
    ("better reference", lambda m: _better(m, "psnr_moving"), ".2f"),
    ("SSIM", lambda m: m["ssim"]["mean"], ".3f"),
    ("centroid error, step 4 (cm)", _motion("centroid_error", 4), ".1f"),
    ("of best constant, step 4 (%)", _motion("centroid_error_over_constant", 4), ".0f"),
    ("of best constant, step 8 (%)", _motion("centroid_error_over_constant", 8), ".0f"),
    ("long rollout finite", _is_finite, ""),
    ("floor drift, worst particle (cm)", lambda m: _hundredfold(_long(m, "floor_drift", "max")), ".2f"),
    ("block size / start, long rollout", _size_range, ""),
]


def table(evaluations: Sequence[Metrics]) -> str:
    """Return the Markdown table; the last row is the mean over the evaluations, where all have a number."""
    rows = [[get(metrics) for _, get, _ in COLUMNS] for metrics in evaluations]
    names = [f"run {number}" for number in range(len(rows))] + ["**mean**"]
    rows.append([_mean(column) for column in zip(*rows, strict=True)])
    lines = ["| | " + " | ".join(name for name, _, _ in COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    for name, row in zip(names, rows, strict=True):
        cells = [_shown(value, form) for value, (_, _, form) in zip(row, COLUMNS, strict=True)]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _mean(column: Sequence[Cell]) -> Cell:
    numbers = [value for value in column if isinstance(value, int | float)]
    return float(np.mean(numbers)) if numbers and len(numbers) == len(column) else None


def _shown(value: Cell, form: str) -> str:
    if value is None:
        return MISSING
    return value if isinstance(value, str) else format(value, form)


if __name__ == "__main__":
    print(table([json.loads(Path(path).read_text()) for path in sys.argv[1:]]))
