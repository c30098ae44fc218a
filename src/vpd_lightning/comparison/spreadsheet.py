"""``report.csv``: one row per run, with all means, intervals and settings."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vpd_lightning.comparison.comparison_table import ComparisonTable, Row
from vpd_lightning.comparison.run import Run
from vpd_lightning.comparison.settings import shown
from vpd_lightning.files import AtomicPath
from vpd_lightning.metrics.registry import SOURCES, compared

_IMAGE_PARTS = ("input_views", "other_views", "pooled")


def write_spreadsheet(path: Path, tables: Sequence[ComparisonTable]) -> None:
    """Write every run. Distances are metres, as in ``metrics.json``; intervals are those of the run alone."""
    rows = [_cells(table, row, run) for table in tables for row in table.rows for run in row.runs]
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with AtomicPath(path) as partial, partial.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)


def _cells(table: ComparisonTable, row: Row, run: Run) -> dict[str, Any]:
    cells: dict[str, Any] = {
        "table": table.title,
        "experiment": run.experiment,
        "system": run.system,
        "row": row.name,
        "is_main": row.is_main,
        "seed": run.seed,
        "settings": "; ".join(shown(key, value) for key, value in row.settings.items()),
        "budget": run.declared_budget,
        "minutes": run.minutes,
        "clock": run.clock,
        "steps": run.steps,
        "parameters": run.num_parameters,
        "milliseconds_per_frame": run.milliseconds_per_frame,
        "finite": run.metrics.get("finite"),
        "folder": str(run.folder),
        "evaluation": run.evaluation.name,
        "data_sha256": run.data_sha256,
        "checkpoint_sha256": run.metrics.get("checkpoint_sha256"),
    }
    for source in SOURCES:
        prefix = "" if source == "model" else f"{source}_"
        for info in compared():
            summary = info.summary(run.metrics, source)
            if summary is None:
                continue
            low, high = summary.get("ci95") or (None, None)
            cells |= {f"{prefix}{info.name}": summary["mean"]}
            cells |= {f"{prefix}{info.name}_low": low, f"{prefix}{info.name}_high": high}
            cells |= {f"{prefix}{info.name}_{part}": summary[part] for part in _IMAGE_PARTS if part in summary}
    native = run.metrics.get("native") or {}
    return cells | {f"native_{key}": _mean(value) for key, value in native.items()}


def _mean(value: Any) -> Any:
    return value.get("mean") if isinstance(value, dict) else value
