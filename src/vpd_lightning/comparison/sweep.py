"""Rows along one setting: the paper's figures over data set size, input views, particles."""

from collections.abc import Hashable
from dataclasses import dataclass

from vpd_lightning.comparison.comparison_table import ComparisonTable, Row
from vpd_lightning.comparison.settings import (
    PARTICLES,
    TRAJECTORIES,
    VIEWS,
    comparable_settings,
    label,
    naming_keys,
    shown,
)

_TITLES = {
    TRAJECTORIES: "training trajectories",
    VIEWS: "input views",
    PARTICLES: "particles",
    "scene.location_noise": "location noise (m)",
    "data.num_steps": "predicted steps in training",
}
_LOGARITHMIC = (TRAJECTORIES, PARTICLES)
_EVENLY_SPACED = ("scene.location_noise",)  # with 0 among powers of ten


@dataclass(frozen=True)
class Sweep:
    """One swept setting of a table: ``lines[name]`` are rows and their places on the axis, from left to right.

    A line is named like its system where all else is as in the system's main row.

    ``names`` are the ticks where places only count the values, else empty; ``is_joined`` where values have an order, so
    that a line may join the points. ``not_placed`` are
    rows trained with all trajectories of a data set that is gone, so that nobody knows how many.
    """

    key: str
    title: str
    is_logarithmic: bool
    lines: dict[str, list[tuple[Row, float]]]
    names: list[str]
    is_joined: bool
    not_placed: list[Row]

    @property
    def points(self) -> list[tuple[Row, float]]:
        """All rows with their places."""
        return [point for line in self.lines.values() for point in line]

    @property
    def file_name(self) -> str:
        """The setting's name in file names."""
        return self.key.removesuffix("._target_").rpartition(".")[2]


def sweeps_of(table: ComparisonTable) -> list[Sweep]:
    """Find every setting that a system was trained with at two values or more, all else that names rows being equal."""
    keys = dict.fromkeys(
        key
        for system in dict.fromkeys(row.system for row in table.rows)
        for key in naming_keys([comparable_settings(row.runs[0]) for row in table.rows if row.system == system])
    )
    found = (_along(table, key) for key in keys)
    return [sweep for sweep in found if sweep is not None]


def _along(table: ComparisonTable, key: str) -> Sweep | None:
    lines: dict[str, list[tuple[Row, Hashable]]] = {}
    for system in dict.fromkeys(row.system for row in table.rows):
        rows = [row for row in table.rows if row.system == system]
        settings = [comparable_settings(row.runs[0]) for row in rows]
        others = [name for name in naming_keys(settings, first=[key]) if name != key]
        usual = next((label(own, others) for row, own in zip(rows, settings, strict=True) if row.is_main), "")
        for row, own in zip(rows, settings, strict=True):
            rest = label(own, others)
            name = system if rest == usual else f"{system} ({rest})"
            if key in own:
                lines.setdefault(name, []).append((row, own[key]))
    if not any(len({value for _, value in line}) > 1 for line in lines.values()):
        return None
    values = list(dict.fromkeys(value for line in lines.values() for _, value in line))
    numbers = {value: _number(key, value) for value in values}
    names: list[str] = []
    is_category = key != TRAJECTORIES and any(number is None for number in numbers.values())
    if is_category:
        lines = {name: line for name, line in lines.items() if len({value for _, value in line}) > 1}
        values = [value for value in values if any(value == other for line in lines.values() for _, other in line)]
    elif key in _EVENLY_SPACED:
        values.sort(key=lambda value: numbers[value] or 0.0)
    if is_category or key in _EVENLY_SPACED:
        names = [shown(key, value).partition("=")[2] for value in values]
        numbers = {value: float(place) for place, value in enumerate(values)}
    placed: dict[str, list[tuple[Row, float]]] = {}
    not_placed: list[Row] = []
    for name, line in lines.items():
        for row, value in line:
            number = numbers[value]
            if number is None:
                not_placed.append(row)
            else:
                placed.setdefault(name, []).append((row, number))
    return Sweep(
        key=key,
        title=_TITLES.get(key, key.removesuffix("._target_")),
        is_logarithmic=key in _LOGARITHMIC,
        lines={name: sorted(line, key=lambda point: point[1]) for name, line in placed.items()},
        names=names,
        is_joined=not is_category,
        not_placed=not_placed,
    )


def _number(key: str, value: Hashable) -> float | None:
    """Where a value stands on the axis; None where it is not a number, or one that is not known."""
    if key == VIEWS and isinstance(value, tuple):
        return float(len(value))
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
