"""Write the measured figures into the pages: ``python -m benchmarks.page [RESULTS_FOLDER] [--check]``.

No figure of README.md, of ``docs/`` or of a card in ``released/`` is typed by hand:

- Between ``<!-- results: FILE VIEW -->`` and ``<!-- end of results -->`` stands what ``VIEWS`` makes of a result file.
- A number in running text is followed by its source, as ``benchmarks/figures.py`` describes.
- A card is written from the files beside it (``benchmarks/cards.py``).

With ``--check`` nothing is written, and the pages that would change are named.
"""

import json
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks import page_tables, picture_tables
from benchmarks.cards import card
from benchmarks.figures import content_of, file_of, with_figures
from benchmarks.measuring import Row
from benchmarks.memory_table import GIB, markdown
from benchmarks.results_files import default_folder, read, shown, table

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "benchmarks.md"
_BLOCK = re.compile(r"(<!-- results: (?P<file>\w+) (?P<view>\w+) -->\n).*?(<!-- end of results -->)", re.DOTALL)


def main(arguments: Sequence[str] | None = None) -> int:
    """Rewrite all pages and cards, or name those that are out of date."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    is_check = "--check" in words
    folders = [Path(word) for word in words if word != "--check"]
    changed = out_of_date(folders[0] if folders else default_folder())
    for path, text in changed.items():
        if not is_check:
            path.write_text(text)
        print(f"{path.relative_to(ROOT)}: {'not what the result files say' if is_check else 'written'}")
    return 1 if is_check and changed else 0


def pages() -> list[Path]:
    """Return README and the pages of ``docs``."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def cards() -> list[Path]:
    """Return the cards of the released models."""
    return sorted((ROOT / "released").glob("*/README.md"))


def out_of_date(folder: Path) -> dict[Path, str]:
    """Return the pages and cards that do not say what the result files say, with what they should be.

    Raises:
        ValueError: a page names a view or a source that does not exist.
    """
    right = {path: _located(path, folder) for path in pages()} | {path: card(path.parent) for path in cards()}
    return {path: text for path, text in right.items() if path.read_text() != text}


def _located(path: Path, folder: Path) -> str:
    try:
        return with_figures(filled(path.read_text(), folder))
    except ValueError as error:
        raise ValueError(f"{path.relative_to(ROOT)}: {error}") from None


def filled(text: str, folder: Path) -> str:
    """Return the page with every block made anew from the result files in ``folder``, or in ``docs/results``.

    Raises:
        ValueError: a block asks for a view that does not exist.
    """

    def block(match: re.Match[str]) -> str:
        view = match["view"]
        if view not in VIEWS:
            raise ValueError(f"There is no view {view!r}; known are {', '.join(VIEWS)}.")
        path = _file(match["file"], folder, is_suite=view not in _READERS or view == "memory")
        content = f"Not measured: `{path.name}` is not among the results."
        if path.exists():
            content = VIEWS[view](_READERS.get(view, read)(path), path)
        return f"{match[1]}{content}\n{match[4]}"

    return _BLOCK.sub(block, text)


def _file(name: str, folder: Path, *, is_suite: bool) -> Path:
    """Results of suites lie in ``folder``, whose machine the page is about; all others where they are committed."""
    if is_suite:
        return folder / f"{name}.json"
    return ROOT / name if (ROOT / name).is_dir() else file_of(name)


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


VIEWS: dict[str, Callable[[Any, Path], str]] = {
    "table": _table,
    "facts": _facts,
    "floors": _floors,
    "plot": _plot,
    "memory": _memory,
    "reading": _reading,
    "making": _making,
}
_OF_RESULTS = (
    "motion",
    "ablation",
    "recipes",
    "report",
    "sparsity",
    "first_velocity",
    "edits",
    "demo",
    "promises",
    "vpd_motion",
)
VIEWS |= {name: getattr(page_tables, name) for name in (*_OF_RESULTS, "releases")}
_OF_PICTURES = ("picture_runs", "picture_sets", "picture_horizons")
VIEWS |= {name: getattr(picture_tables, name) for name in _OF_PICTURES}
# How a view's file is read, where it is not the result of a suite.
_READERS: dict[str, Callable[[Path], Any]] = dict.fromkeys((*_OF_RESULTS, *_OF_PICTURES), content_of)
_READERS |= {"memory": lambda path: json.loads(path.read_text()), "releases": lambda path: None}


if __name__ == "__main__":
    sys.exit(main())
