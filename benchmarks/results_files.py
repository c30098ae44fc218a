"""Result files of a suite: JSON, CSV, a Markdown table on the screen."""

import csv
import json
import platform
from collections.abc import Sequence
from dataclasses import asdict, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from benchmarks.measuring import Result, Row, device_name

PACKAGES = ("torch", "numpy", "scipy", "numba", "triton", "torch-cluster", "torch-geometric", "lightning")


def versions() -> dict[str, str]:
    """Return the versions of Python and of what is installed of ``PACKAGES``."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def default_folder() -> Path:
    """Return ``benchmarks/results`` of a checkout, or ``bench_results`` below the working folder elsewhere."""
    here = Path(__file__).resolve().parent
    is_checkout = (here.parent / "pyproject.toml").is_file()
    return here / "results" if is_checkout else Path("bench_results")


def write(suite: str, device: torch.device, result: Result, folder: Path) -> Path:
    """Write ``<suite>_<device>.json`` and ``.csv`` into ``folder``, print the table, and return the JSON's path."""
    content = {
        "suite": suite,
        "device": device_name(device),
        "versions": versions(),
        "rows": [asdict(item) for item in result.rows],
        "facts": dict(result.facts),
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{suite}_{device.type}.json"
    path.write_text(json.dumps(content, indent=1) + "\n")
    with path.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.writer(file)
        names = [item.name for item in fields(Row)]
        writer.writerow(names)
        writer.writerows([[getattr(item, name) for name in names] for item in result.rows])
    print(f"\n{suite}: {content['device']}\n\n{table(result.rows)}\n")
    for name, value in result.facts.items():
        print(f"{name}: {shown(value)}")
    return path


def read(path: Path) -> dict[str, Any]:
    """Return a result file with its rows as ``Row``."""
    content = json.loads(path.read_text())
    content["rows"] = [Row(**item) for item in content["rows"]]
    return content


def shown(value: Any) -> str:
    """Return a number in four digits, anything else as it is."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def table(rows: Sequence[Row]) -> str:
    """Return the rows as a Markdown table; columns that nobody fills are left out."""
    if not rows:
        return ""
    columns = {
        "what": lambda r: r.name,
        "ms": lambda r: _number(r.seconds, 1000, ".2f"),
        "baseline ms": lambda r: _number(r.baseline_seconds, 1000, ".2f"),
        "ratio": lambda r: _number(r.ratio, 1, ".2f", "x"),
        "error": lambda r: _number(r.error, 1, ".1e"),
        "PSNR": lambda r: _number(r.psnr, 1, ".2f"),
        "MiB": lambda r: _number(r.peak_bytes, 2**-20, ".0f"),
        "baseline": lambda r: r.baseline,
        "note": lambda r: r.note,
    }
    cells = {title: [get(item) for item in rows] for title, get in columns.items()}
    used = {title: values for title, values in cells.items() if any(values)}
    numbers = ("ms", "baseline ms", "ratio", "error", "PSNR", "MiB")
    lines = ["| " + " | ".join(used) + " |", "|" + "|".join("---:" if t in numbers else "---" for t in used) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(cell) + " |" for cell in zip(*used.values(), strict=True))])


def _number(value: float | None, factor: float, form: str, unit: str = "") -> str:
    return "" if value is None else f"{value * factor:{form}}{unit}"
