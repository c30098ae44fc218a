"""Figures in running text, each followed by where it comes from.

``20.39<!-- figure: movi_a_inertial > psnr_moving > mean -->`` says that the number before the comment is what stands
there in a committed file, rounded to the digits that are printed. Words after the path change it:

- ``minus FILE > PATH`` and ``divided by FILE > PATH`` do that; without a file (``minus > PATH``) it is the same one;
- ``in UNIT`` (cm, mm, ms, %, minutes, GiB, ...) takes metres, seconds, shares and bytes as that unit.

A file is ``NAME`` for ``docs/results/NAME.json``, ``benchmarks/results/NAME.json``, ``released/NAME/metrics.json`` or
``docs/results/NAME/report.csv``. In a path, ``*`` is the mean over everything there; a number counts from 0; a
name picks from a list the entry with that ``name``. Lines of a CSV file are picked by their ``row``.
"""

import csv
import json
import re
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
UNITS = {
    "cm": 100.0, "mm": 1000.0, "ms": 1000.0, "%": 100.0, "minutes": 1 / 60, "MB": 1e-6, "MiB": 2.0**-20,
    "GiB": 2.0**-30, "billions": 1e-9,
}  # fmt: skip
PLACES = (
    "docs/results/{}.json",
    "benchmarks/results/{}.json",
    "released/{}/metrics.json",
    "docs/results/{}/report.csv",
)
FIGURE = re.compile(r"(?P<number>-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?)(?P<between>\**)<!-- figure: (?P<source>.*?) -->")


def with_figures(text: str) -> str:
    """Return the text with every marked number as its source has it, in as many digits as are printed.

    Raises:
        ValueError: a comment follows no number, or names something that is not there.
    """
    marked = text.count("<!-- figure: ")
    if marked != len(FIGURE.findall(text)):
        places = [text[max(0, m.start() - 30) : m.end()] for m in re.finditer(r"(?<![\d*])<!-- figure: .*?-->", text)]
        raise ValueError(f"A comment '<!-- figure: ... -->' must follow a number: {places}")
    return FIGURE.sub(lambda match: _again(match) + match[0][len(match["number"]) :], text)


def value_of(source: str) -> float:
    """Return what a source such as ``motion_test > movi_a > inertial > * > step 4 in cm`` amounts to.

    Raises:
        ValueError: there is no such file, entry or unit, or what is there is no number.
    """
    body, unit = re.fullmatch(r"(.*?)(?: in (\S+))?", source).groups()  # type: ignore[union-attr]
    if unit is not None and unit not in UNITS:
        raise ValueError(f"{source!r}: unknown unit {unit!r}; known are {', '.join(UNITS)}")
    first, *rest = re.split(r" (minus|divided by) ", body)
    name = first.split(" > ")[0]
    value = _look_up(first)
    for operation, path in zip(rest[::2], rest[1::2], strict=True):
        other = _look_up(name + " " + path if path.startswith("> ") else path)
        value = value - other if operation == "minus" else value / other
    return value * UNITS.get(unit, 1.0)


def file_of(name: str) -> Path:
    """Return the file that a short name stands for.

    Raises:
        ValueError: there is none.
    """
    for place in PLACES:
        path = ROOT / place.format(name)
        if path.is_file():
            return path
    raise ValueError(f"no file of results is called {name!r}; looked for {', '.join(p.format(name) for p in PLACES)}")


@cache
def content_of(path: Path) -> Any:
    """Return a JSON file's content; of a CSV file its lines by their ``row``."""
    if path.suffix == ".json":
        return json.loads(path.read_text())
    with path.open(newline="") as stream:
        return {line["row"]: line for line in csv.DictReader(stream)}


def _again(match: re.Match[str]) -> str:
    number, _, power = match["number"].partition("e")
    digits = len(number.partition(".")[2])
    if power:
        mantissa, _, power = format(value_of(match["source"]), f".{digits}e").partition("e")
        return f"{mantissa}e{int(power)}"
    return format(value_of(match["source"]), f"{',' if ',' in number else ''}.{digits}f")


def _look_up(path: str) -> float:
    name, *keys = path.split(" > ")
    value = _descend(content_of(file_of(name)), keys, path)
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{path!r} is no number, but {str(value)[:80]!r}") from None


def _descend(content: Any, keys: list[str], path: str) -> Any:
    for index, key in enumerate(keys):
        if key == "*":
            entries = list(content.values() if isinstance(content, dict) else content)
            return sum(float(_descend(entry, keys[index + 1 :], path)) for entry in entries) / len(entries)
        try:
            if isinstance(content, dict):
                content = content[key]
            elif re.fullmatch(r"-?\d+", key):
                content = content[int(key)]
            else:
                content = next(entry for entry in content if entry["name"] == key)
        except (KeyError, IndexError, TypeError, StopIteration):
            known = list(content) if isinstance(content, dict) else f"{len(content)} entries"
            raise ValueError(f"{path!r}: there is no {key!r}; there is {str(known)[:300]}") from None
    return content
