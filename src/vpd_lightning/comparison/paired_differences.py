"""Who is best at what, and by how much: statements about the main rows of a table."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

from vpd_lightning.comparison.bootstrap import Estimate, MetricSamples, difference
from vpd_lightning.comparison.comparison_table import ComparisonTable, Row
from vpd_lightning.metrics.metric_info import MetricInfo
from vpd_lightning.metrics.registry import REFERENCES, paired


@dataclass(frozen=True)
class Standing:
    """The best row of one metric, and the others whose interval overlaps its interval."""

    info: MetricInfo
    best: Row
    within: tuple[Row, ...]
    num_rows: int


def differing_budgets(rows: Sequence[Row]) -> bool:
    """Tell whether some of the rows were allowed more than others."""
    return len({run.declared_budget for row in rows for run in row.runs}) > 1


def standing(rows: Sequence[Row], info: MetricInfo) -> Standing | None:
    """Rank the rows that have the metric; None where fewer than two have it, or where some were allowed more."""
    if differing_budgets(rows):
        return None
    known = {row.name: found for row in rows if (found := row.estimate(info.name)) is not None}
    ranked = sorted((row for row in rows if row.name in known), key=lambda row: info.distance(known[row.name].mean))
    if len(ranked) < 2:
        return None
    best = ranked[0]
    within = tuple(row for row in ranked[1:] if known[row.name].overlaps(known[best.name]))
    return Standing(info, best, within, len(ranked))


def told_apart(place: Standing, num_bootstrap: int) -> list[Row]:
    """The rows within the interval of the best that are worse than it on the same clips all the same."""
    found = []
    for row in place.within:
        first, second = place.best.samples(place.info.name), row.samples(place.info.name)
        if first is None or second is None or place.info.better == "one":
            continue
        if first.total.shape[1:] != second.total.shape[1:]:
            continue
        result = difference(first, second, num_bootstrap)
        sign = 1.0 if place.info.better == "higher" else -1.0
        if result is not None and result[0].interval and min(sign * end for end in result[0].interval) > 0:
            found.append(row)
    return found


def paired_differences(table: ComparisonTable) -> Iterator[tuple[str, str, dict[str, tuple[Estimate, int]]]]:
    """Yield (first, second, differences by metric) for every pair of systems, and every system and reference.

    Each difference is first minus second, an estimate and the number of trajectories that both have values for.
    """
    rows, names = table.main_rows, [info.name for info in paired()]
    for first, second in combinations(rows, 2):
        yield first.system, second.system, _differences(table, first, {name: second.samples(name) for name in names})
    for row in rows:
        for source in REFERENCES:
            yield row.system, source, _differences(table, row, {n: table.reference_samples(source, n) for n in names})


def _differences(
    table: ComparisonTable, first: Row, seconds: dict[str, MetricSamples | None]
) -> dict[str, tuple[Estimate, int]]:
    num_bootstrap = table.runs[0].num_bootstrap
    found = {}
    for name, second in seconds.items():
        own = first.samples(name)
        if own is None or second is None or own.total.shape[1:] != second.total.shape[1:]:
            continue
        result = difference(own, second, num_bootstrap)
        if result is not None:
            found[name] = result
    return found
