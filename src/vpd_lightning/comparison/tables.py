"""The tables of a report, in Markdown."""

from collections.abc import Iterable, Sequence

from vpd_lightning.comparison.bootstrap import Estimate, estimate
from vpd_lightning.comparison.comparison_table import ComparisonTable, Row, system_order
from vpd_lightning.comparison.paired_differences import (
    Standing,
    differing_budgets,
    paired_differences,
    standing,
    told_apart,
)
from vpd_lightning.comparison.run import Run
from vpd_lightning.comparison.settings import shown
from vpd_lightning.metrics.metric_info import MetricInfo
from vpd_lightning.metrics.registry import REFERENCES, compared, paired, references_of

TITLES = {"copy_last": "copy last input frame", "train_mean": "training mean"}
_WITHIN = " ~"


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lay out a table; the first column is text, the others are numbers."""
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1)]
    return [*lines, *("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows)]


def overview(tables: Sequence[ComparisonTable], info: MetricInfo) -> list[str]:
    """Systems in rows, data sets in columns, like the paper's tables; references below."""
    systems = sorted({row.system for table in tables for row in table.main_rows}, key=system_order)
    standings = [standing(table.main_rows, info) for table in tables]
    lines = []
    for system in systems:
        cells = []
        for table, place in zip(tables, standings, strict=True):
            row = next((row for row in table.main_rows if row.system == system), None)
            cells.append(_cell(info, row.estimate(info.name), row, place) if row else "-")
        lines.append([system, *cells])
    for source in REFERENCES:
        found = [table.reference(source, info.name) for table in tables]
        lines.append([f"*{TITLES[source]}*", *(estimate_text(info, one) for one in found)])
    return markdown([info.label, *(table.title for table in tables)], lines)


def systems_table(table: ComparisonTable) -> list[str]:
    """One row per system in its main setting, and what needs no learning, of images and of motion."""
    infos = _present(table, table.main_rows)
    places = {info.name: standing(table.main_rows, info) for info in infos}
    lines = []
    for row in table.main_rows:
        cells = [_cell(info, row.estimate(info.name), row, places[info.name]) for info in infos]
        lines.append([row.system, *cells, *_cost(row)])
    for source in REFERENCES:
        cells = [estimate_text(info, table.reference(source, info.name)) for info in infos]
        lines.append([f"*{TITLES[source]}*", *cells, *["-"] * len(_COST)])
    for info in infos:
        for other in references_of(info):
            samples = table.reference_samples("model", other.name)
            found = None if samples is None else estimate(samples, table.runs[0].num_bootstrap)
            if found is not None:
                cells = [estimate_text(info, found) if one is info else "-" for one in infos]
                lines.append([f"*{other.title}*", *cells, *["-"] * len(_COST)])
    return markdown(["system", *(info.label for info in infos), *_COST], lines)


def settings_table(table: ComparisonTable) -> list[str]:
    """Every setting of the systems that were trained in more than one; nothing is marked as best here."""
    rows = [row for row in table.rows if sum(other.system == row.system for other in table.rows) > 1]
    infos = _present(table, rows)
    lines = [[row.name, *(estimate_text(info, row.estimate(info.name)) for info in infos), *_cost(row)] for row in rows]
    return markdown(["system and setting", *(info.label for info in infos), *_COST], lines) if rows else []


def settings_lists(table: ComparisonTable) -> list[str]:
    """All settings in which the rows of one system differ, also those that follow from another."""
    lines = []
    for row in table.rows:
        if row.settings and any(other.system == row.system and other is not row for other in table.rows):
            lines.append(f"- {row.name}: " + ", ".join(f"`{shown(k, v)}`" for k, v in row.settings.items()))
    return lines


def winners(table: ComparisonTable) -> list[str]:
    """One line per metric: which is best, and which do not differ from it significantly."""
    if len(table.main_rows) > 1 and differing_budgets(table.main_rows):
        return ["No system is called best, here and in the tables: their training budgets differ."]
    lines = []
    for info in compared():
        place = standing(table.main_rows, info)
        if place is None:
            continue
        best = place.best.estimate(info.name)
        words = f"- {info.label}: {place.best.system} ({info.shown(best.mean if best else None)})"
        if not place.within:
            words += ", and no other system's interval reaches its own"
        elif len(place.within) + 1 == place.num_rows:
            words += "; all others are within the interval"
        else:
            words += f"; {_are([row.system for row in place.within])} within the interval"
        behind = [row.system for row in told_apart(place, table.runs[0].num_bootstrap)]
        if behind:
            words += f", though on the same clips {_are(behind)} worse"
        lines.append(words + "." + _better_references(table, info, best))
    return lines


def _better_references(table: ComparisonTable, info: MetricInfo, best: Estimate | None) -> str:
    """Say where what predicts nothing is as good as the best system: being the best means nothing there."""
    known = {TITLES[source]: found for source in REFERENCES if (found := table.reference(source, info.name))}
    better = {title: info.shown(found.mean) for title, found in known.items()
              if best and info.distance(found.mean) <= info.distance(best.mean)}  # fmt: skip
    if not better:
        return ""
    listed = " and ".join(f"{title} ({value})" for title, value in better.items())
    return f" **No better than what predicts nothing: {listed}.**"


def differences_table(table: ComparisonTable) -> list[str]:
    """Mean differences of pairs on the same clips."""
    lines = []
    pairs = [pair for pair in paired_differences(table) if pair[2]]
    infos = [info for info in paired() if any(info.name in found for _, _, found in pairs)]
    for first, second, found in pairs:
        cells = [difference_text(info, found[info.name][0]) if info.name in found else "-" for info in infos]
        counts = sorted({number for _, number in found.values()})
        second = f"*{TITLES[second]}*" if second in TITLES else second
        lines.append(
            [f"{first} - {second}", *cells, " to ".join(str(count) for count in sorted({counts[0], counts[-1]}))]
        )
    head = ["first - second", *(info.label for info in infos), "trajectories"]
    return markdown(head, lines) if lines else []


def _present(table: ComparisonTable, rows: Sequence[Row]) -> list[MetricInfo]:
    return [info for info in compared() if any(row.estimate(info.name) is not None for row in rows)]


_COST = ("budget", "minutes", "clock", "steps", "parameters", "ms per picture", "seeds")


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
        "-" if row.milliseconds_per_frame is None else f"{row.milliseconds_per_frame:.1f}",
        str(len(row.runs)),
    ]


def _mean_count(values: Sequence[int | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{round(sum(known) / len(known)):,}" if known else "-"


def _count(run: Run) -> str:
    return "-" if run.num_parameters is None else f"{run.num_parameters:,}"


def _cell(info: MetricInfo, found: Estimate | None, row: Row, place: Standing | None) -> str:
    """Bold: best, and alone; a tilde: the best or within its interval."""
    text = estimate_text(info, found)
    if place is None or found is None:
        return text
    if row is place.best and not place.within:
        value, space, rest = text.partition(" ")
        return f"**{value}**{space}{rest}"
    return text + (_WITHIN if row is place.best or row in place.within else "")


def estimate_text(info: MetricInfo, found: Estimate | None) -> str:
    """A mean as the metric is printed, with its interval in brackets; a dash where there is none."""
    if found is None:
        return "-"
    if found.interval is None:
        return info.shown(found.mean)
    return f"{info.shown(found.mean)} [{info.shown(found.interval[0])}, {info.shown(found.interval[1])}]"


def difference_text(info: MetricInfo, found: Estimate) -> str:
    """The same of a difference, with its sign."""
    values = [found.mean, *(found.interval or ())]
    mean, *ends = [f"{info.scale * value:+.{info.digits}f}" for value in values]
    return f"{mean} [{', '.join(ends)}]" if ends else mean


def _are(names: Sequence[str]) -> str:
    return f"{names[0]} is" if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]} are"
