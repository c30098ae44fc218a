"""Who is best at what, and by how much: statements about the main rows of a board."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

from vpd_lightning.comparison.bootstrap import Estimate, Sums, difference
from vpd_lightning.comparison.comparison_table import Board, Row
from vpd_lightning.comparison.measure import BY_NAME, REFERENCES, Measure

PAIRED = ("psnr", "psnr_moving", "ssim", "centroid_error")


@dataclass(frozen=True)
class Standing:
    """The best row of one measure, and the others whose interval overlaps its interval."""

    measure: Measure
    best: Row
    within: tuple[Row, ...]
    num_rows: int


def differing_budgets(rows: Sequence[Row]) -> bool:
    """Tell whether some of the rows were allowed more than others."""
    return len({run.declared_budget for row in rows for run in row.runs}) > 1


def standing(rows: Sequence[Row], measure: Measure) -> Standing | None:
    """Rank the rows that have the measure; None where fewer than two have it, or where some were allowed more."""
    if differing_budgets(rows):
        return None
    known = {row.name: found for row in rows if (found := row.estimate(measure.name)) is not None}
    ranked = sorted((row for row in rows if row.name in known), key=lambda row: measure.distance(known[row.name].mean))
    if len(ranked) < 2:
        return None
    best = ranked[0]
    within = tuple(row for row in ranked[1:] if known[row.name].overlaps(known[best.name]))
    return Standing(measure, best, within, len(ranked))


def told_apart(place: Standing, num_bootstrap: int) -> list[Row]:
    """The rows within the interval of the best that are worse than it on the same clips all the same."""
    found = []
    for row in place.within:
        first, second = place.best.sums(place.measure.name), row.sums(place.measure.name)
        if first is None or second is None or place.measure.better == "one":
            continue
        if first.total.shape[1:] != second.total.shape[1:]:
            continue
        result = difference(first, second, num_bootstrap)
        sign = 1.0 if place.measure.better == "higher" else -1.0
        if result is not None and result[0].interval and min(sign * end for end in result[0].interval) > 0:
            found.append(row)
    return found


def paired_differences(board: Board) -> Iterator[tuple[str, str, dict[str, tuple[Estimate, int]]]]:
    """Yield (first, second, differences by measure) for every pair of systems, and every system and reference.

    Each difference is first minus second, an estimate and the number of trajectories that both have values for.
    """
    rows = board.main_rows
    for first, second in combinations(rows, 2):
        yield first.system, second.system, _differences(board, first, {name: second.sums(name) for name in PAIRED})
    for row in rows:
        for source in REFERENCES:
            yield row.system, source, _differences(board, row, {n: board.reference_sums(source, n) for n in PAIRED})


def _differences(board: Board, first: Row, seconds: dict[str, Sums | None]) -> dict[str, tuple[Estimate, int]]:
    num_bootstrap = board.runs[0].num_bootstrap
    found = {}
    for name, second in seconds.items():
        own = first.sums(name)
        if own is None or second is None or own.total.shape[1:] != second.total.shape[1:]:
            continue
        result = difference(own, second, num_bootstrap)
        if result is not None:
            found[BY_NAME[name].name] = result
    return found
