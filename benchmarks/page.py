"""Write the measured figures into ``docs/benchmarks.md``: ``python -m benchmarks.page [RESULTS_FOLDER]``.

No figure on that page is typed by hand. Between ``<!-- results: FILE VIEW -->`` and ``<!-- end of results -->`` stands
what this module made of ``FILE.json``; VIEW is ``table``, ``facts``, ``floors`` (of train_step),
``memory`` (of memory_table), ``reading``, ``making`` (of data) or ``plot``.
"""

import json
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.measuring import Row
from benchmarks.memory_table import GIB, markdown
from benchmarks.results_files import default_folder, read, shown, table

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "benchmarks.md"
_BLOCK = re.compile(r"(<!-- results: (?P<file>\w+) (?P<view>\w+) -->\n).*?(<!-- end of results -->)", re.DOTALL)


def main() -> None:
    """Rewrite all blocks of the page."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else default_folder()
    PAGE.write_text(filled(PAGE.read_text(), folder))
    print(PAGE)


def filled(text: str, folder: Path) -> str:
    """Return the page with every block made anew from the result files in ``folder``.

    Raises:
        ValueError: a block asks for a view that does not exist.
    """

    def block(match: re.Match[str]) -> str:
        view = match["view"]
        if view not in VIEWS:
            raise ValueError(f"There is no view {view!r}; known are {', '.join(VIEWS)}.")
        path = folder / f"{match['file']}.json"
        if path.exists():
            content = VIEWS[view](json.loads(path.read_text()) if view == "memory" else read(path), path)
        else:
            content = f"Not measured: `{path.name}` is not among the results."
        return f"{match[1]}{content}\n{match[4]}"

    return _BLOCK.sub(block, text)


def _table(content: dict[str, Any], path: Path) -> str:
    """Device, rows, and the notes: those that all rows share stand below."""
    rows: Sequence[Row] = content["rows"]
    lines = [_machine(content), ""]
    notes = {item.note for item in rows}
    if len(notes) == 1:
        lines += [table([replace(item, note="") for item in rows]), *[f"\n{note}." for note in notes if note]]
    else:
        lines.append(table(rows))
    return "\n".join(lines)


def _facts(content: dict[str, Any], path: Path) -> str:
    lines = ["| number | value |", "|---|---:|"]
    return "\n".join([*lines, *(f"| {name} | {shown(value)} |" for name, value in content["facts"].items())])


def _floors(content: dict[str, Any], path: Path) -> str:
    """Operations and bytes of each stage of a training step, its floor at measured rates, and how near it is."""
    facts, rows = content["facts"], {item.name: item for item in content["rows"]}
    lines = [
        f"At {facts['gemm_operations_per_second'] / 1e9:.0f} billion operations and "
        f"{facts['copied_bytes_per_second'] / 1e9:.1f} billion bytes a second, both measured in the same run:",
        "",
        "| stage | billion operations | million bytes | floor ms | measured ms | floor / measured |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    names = {"encode": "encode", "dynamics": "dynamics", "render": "render", "backward": "backward (twice all three)"}
    total = {"operations": 0.0, "bytes": 0.0}
    for name, title in names.items():
        if name == "backward":
            amounts = [2 * total[kind] for kind in total]
        else:
            amounts = [facts[f"{name}_{kind}"] for kind in total]
            total = {kind: total[kind] + facts[f"{name}_{kind}"] for kind in total}
        floor, share = facts[f"{name}_floor_seconds"], facts[f"{name}_floor_share"]
        cells = [f"{amounts[0] / 1e9:.1f}", f"{amounts[1] / 1e6:.0f}", f"{1000 * floor:.0f}"]
        cells += [f"{1000 * (rows[f'stage/{name}'].seconds or 0):.0f}", f"{100 * share:.0f} %"]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _plot(content: dict[str, Any], path: Path) -> str:
    picture = path.with_suffix(".png").name
    return f"![{content['suite']} on {content['device']}](../benchmarks/results/{picture})"


def _memory(content: dict[str, Any], path: Path) -> str:
    """The accounting of ``memory_table``, whose rows are its own, and the steps that were really taken."""
    measured = ", ".join(f"{item['peak'] / GIB:.2f} GiB with {item['particles']:,}" for item in content["measured"])
    taken = f"Peak of a process that takes one dynamics step, forward and backward: {measured}."
    return f"{markdown(content['rows'])}\n\n{taken}"


def _reading(content: dict[str, Any], path: Path) -> str:
    """All rows but those of making trajectories."""
    return _table({**content, "rows": [item for item in content["rows"] if not item.name.startswith("make/")]}, path)


def _making(content: dict[str, Any], path: Path) -> str:
    """One line per data set: processor time of a trajectory by stage, views a second, the time of the whole set."""
    seconds: dict[str, dict[str, float]] = {}
    notes: dict[str, str] = {}
    for item in content["rows"]:
        if item.name.startswith("make/"):
            _, scene, stage = item.name.split("/")
            seconds.setdefault(scene, {})[stage] = item.seconds or 0.0
            notes[scene] = item.note or notes.get(scene, "")
    stages = ("simulate", "render", "write", "whole")
    titles = [
        "data set",
        *(f"{stage} (CPU s)" for stage in stages),
        "views per CPU second",
        "whole set (CPU min)",
        "note",
    ]
    lines = [_machine(content), "", "| " + " | ".join(titles) + " |", "|---|" + "---:|" * 6 + "---|"]
    for scene, taken in seconds.items():
        cells = [f"{taken.get(stage, 0.0):.2f}" for stage in stages]
        cells += [f"{content['facts'][f'{name}, {scene}']:.0f}" for name in ("views per CPU second", "CPU minutes")]
        lines.append(f"| {scene} | " + " | ".join(cells) + f" | {notes[scene]} |")
    return "\n".join(lines)


def _machine(content: dict[str, Any]) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in content["versions"].items())
    return f"{content['device']}; {versions}."


VIEWS: dict[str, Callable[[dict[str, Any], Path], str]] = {
    "table": _table,
    "facts": _facts,
    "floors": _floors,
    "plot": _plot,
    "memory": _memory,
    "reading": _reading,
    "making": _making,
}


if __name__ == "__main__":
    main()
