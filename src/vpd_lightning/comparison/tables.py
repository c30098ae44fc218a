"""The tables of a report, in Markdown."""

from collections.abc import Iterable, Sequence

from vpd_lightning.comparison.bootstrap import Estimate
from vpd_lightning.comparison.comparison_table import Board, Row, system_order
from vpd_lightning.comparison.measure import BY_NAME, MEASURES, REFERENCES, Measure
from vpd_lightning.comparison.paired_differences import (
    PAIRED,
    Standing,
    differing_budgets,
    paired_differences,
    standing,
    told_apart,
)
from vpd_lightning.comparison.run import Run
from vpd_lightning.comparison.settings import shown

TITLES = {"copy_last": "copy last input frame", "train_mean": "training mean"}
_WITHIN = " ~"


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lay out a table; the first column is text, the others are numbers."""
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1)]
    return [*lines, *("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows)]


def overview(boards: Sequence[Board], measure: Measure) -> list[str]:
    """Systems in rows, data sets in columns, like the paper's tables; references below."""
    systems = sorted({row.system for board in boards for row in board.main_rows}, key=system_order)
    standings = [standing(board.main_rows, measure) for board in boards]
    lines = []
    for system in systems:
        cells = []
        for board, place in zip(boards, standings, strict=True):
            row = next((row for row in board.main_rows if row.system == system), None)
            cells.append(_cell(measure, row.estimate(measure.name), row, place) if row else "-")
        lines.append([system, *cells])
    for source in REFERENCES:
        found = [board.reference(source, measure.name) for board in boards]
        lines.append([f"*{TITLES[source]}*", *(_estimate(measure, one) for one in found)])
    return markdown([measure.title, *(board.title for board in boards)], lines)


def systems_table(board: Board) -> list[str]:
    """One row per system in its main setting, and the two references."""
    measures = _present(board, board.main_rows)
    places = {measure.name: standing(board.main_rows, measure) for measure in measures}
    lines = []
    for row in board.main_rows:
        cells = [_cell(measure, row.estimate(measure.name), row, places[measure.name]) for measure in measures]
        lines.append([row.system, *cells, *_cost(row)])
    for source in REFERENCES:
        cells = [_estimate(measure, board.reference(source, measure.name)) for measure in measures]
        lines.append([f"*{TITLES[source]}*", *cells, *["-"] * len(_COST)])
    return markdown(["system", *(measure.title for measure in measures), *_COST], lines)


def settings_table(board: Board) -> list[str]:
    """Every setting of the systems that were trained in more than one; nothing is marked as best here."""
    rows = [row for row in board.rows if sum(other.system == row.system for other in board.rows) > 1]
    measures = _present(board, rows)
    lines = [
        [row.name, *(_estimate(measure, row.estimate(measure.name)) for measure in measures), *_cost(row)]
        for row in rows
    ]
    return markdown(["system and setting", *(measure.title for measure in measures), *_COST], lines) if rows else []


def settings_lists(board: Board) -> list[str]:
    """All settings in which the rows of one system differ, also those that follow from another."""
    lines = []
    for row in board.rows:
        if row.settings and any(other.system == row.system and other is not row for other in board.rows):
            lines.append(f"- {row.name}: " + ", ".join(f"`{shown(k, v)}`" for k, v in row.settings.items()))
    return lines


def winners(board: Board) -> list[str]:
    """One line per measure: who is best, and who cannot be told from it."""
    if len(board.main_rows) > 1 and differing_budgets(board.main_rows):
        return ["No system is called best, here and in the tables: their training budgets differ."]
    lines = []
    for measure in MEASURES:
        place = standing(board.main_rows, measure)
        if place is None:
            continue
        best = place.best.estimate(measure.name)
        words = f"- {measure.title}: {place.best.system} ({measure.shown(best.mean if best else None)})"
        if not place.within:
            words += ", and no other system's interval reaches its own"
        elif len(place.within) + 1 == place.num_rows:
            words += "; all others are within the interval"
        else:
            words += f"; {_are([row.system for row in place.within])} within the interval"
        behind = [row.system for row in told_apart(place, board.runs[0].num_bootstrap)]
        if behind:
            words += f", though on the same clips {_are(behind)} worse"
        lines.append(words + ".")
    return lines


def differences_table(board: Board) -> list[str]:
    """Mean differences of pairs on the same clips."""
    lines = []
    for first, second, found in paired_differences(board):
        if not found:
            continue
        cells = [_difference(BY_NAME[name], found[name][0]) if name in found else "-" for name in PAIRED]
        counts = sorted({number for _, number in found.values()})
        second = f"*{TITLES[second]}*" if second in TITLES else second
        lines.append(
            [f"{first} - {second}", *cells, " to ".join(str(count) for count in sorted({counts[0], counts[-1]}))]
        )
    head = ["first - second", *(BY_NAME[name].title for name in PAIRED), "trajectories"]
    return markdown(head, lines) if lines else []


def _present(board: Board, rows: Sequence[Row]) -> list[Measure]:
    return [measure for measure in MEASURES if any(row.estimate(measure.name) is not None for row in rows)]


_COST = ("budget", "minutes", "clock", "steps", "parameters", "seeds")


def _cost(row: Row) -> list[str]:
    def each(values: Iterable[str]) -> str:
        return " / ".join(dict.fromkeys(values))

    minutes = [run.minutes for run in row.runs if run.minutes is not None]
    return [
        each(run.declared_budget for run in row.runs),
        f"{sum(minutes) / len(minutes):.1f}" if minutes else "-",
        each(run.clock for run in row.runs),
        _mean_count([run.steps for run in row.runs]),
        each(_count(run) for run in row.runs),
        str(len(row.runs)),
    ]


def _mean_count(values: Sequence[int | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{round(sum(known) / len(known)):,}" if known else "-"


def _count(run: Run) -> str:
    return "-" if run.num_parameters is None else f"{run.num_parameters:,}"


def _cell(measure: Measure, found: Estimate | None, row: Row, place: Standing | None) -> str:
    """Bold: best, and alone; a tilde: the best or within its interval."""
    text = _estimate(measure, found)
    if place is None or found is None:
        return text
    if row is place.best and not place.within:
        value, space, rest = text.partition(" ")
        return f"**{value}**{space}{rest}"
    return text + (_WITHIN if row is place.best or row in place.within else "")


def _estimate(measure: Measure, found: Estimate | None) -> str:
    if found is None:
        return "-"
    if found.interval is None:
        return measure.shown(found.mean)
    return f"{measure.shown(found.mean)} [{measure.shown(found.interval[0])}, {measure.shown(found.interval[1])}]"


def _difference(measure: Measure, found: Estimate) -> str:
    values = [found.mean, *(found.interval or ())]
    mean, *ends = [f"{measure.scale * value:+.{measure.digits}f}" for value in values]
    return f"{mean} [{', '.join(ends)}]" if ends else mean


def _are(names: Sequence[str]) -> str:
    return f"{names[0]} is" if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]} are"
