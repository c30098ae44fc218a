"""What a reader must know before comparing the rows of a table."""

from collections.abc import Mapping, Sequence

from vpd_lightning.comparison.comparison_table import ComparisonTable, Row
from vpd_lightning.comparison.paired_differences import differing_budgets
from vpd_lightning.comparison.settings import PACE, comparable_settings, shown
from vpd_lightning.metrics.registry import HEADLINE, REFERENCES, metric

_TIME_TOLERANCE = 0.2
_USED = 0.95  # of the budget; a training that ended by itself before has less behind it
_SAME_REFERENCE = 1e-6


def parted_experiments(tables: Sequence[ComparisonTable]) -> list[str]:
    """Say where data sets or protocols part the runs of one experiment."""
    found = []
    for experiment in dict.fromkeys(table.experiment for table in tables):
        same = [table for table in tables if table.experiment == experiment]
        if len(same) > 1:
            digests = {table.data_sha256 for table in same}
            what = "with different protocols" if len(digests) == 1 else "on different data"
            found.append(
                f"{experiment}: its runs were evaluated {what}, so they stand in {len(same)} tables "
                f"({', '.join(table.title for table in same)}) and must not be compared across them."
            )
    return found


def table_warnings(table: ComparisonTable) -> list[str]:
    """Say what the rows of a table do not share, and what is missing."""
    rows = table.main_rows
    found = []
    if differing_budgets(rows):
        budgets = _by_row(rows, lambda row: sorted({run.declared_budget for run in row.runs}))
        found.append(f"the training budgets of the systems differ: {budgets}.")
    else:
        found += _measured_times(rows)
    for system in dict.fromkeys(row.system for row in table.rows):
        own = [row for row in table.rows if row.system == system]
        if differing_budgets(own):
            budgets = ", ".join(sorted({run.declared_budget for row in own for run in row.runs}))
            found.append(f"the settings of {system} were trained with different budgets: {budgets}.")
    found += [*_budget_use(table), *_differing_pace(table)]
    checkpoints = {run.checkpoint_name for row in rows for run in row.runs if run.checkpoint_name is not None}
    if len(checkpoints) > 1:
        names = _by_row(rows, lambda row: sorted({str(run.checkpoint_name) for run in row.runs}))
        found.append(f"not the same of each run's checkpoints was evaluated: {names}.")
    seeds = {row.system: len(row.runs) for row in rows}
    if len(set(seeds.values())) > 1:
        found.append(f"the numbers of seeds differ: {', '.join(f'{name} {count}' for name, count in seeds.items())}.")
    views = _by_row(
        rows, lambda row: sorted({len(run.metrics["protocol"].get("input_views") or ()) for run in row.runs})
    )
    if len({tuple(run.metrics["protocol"].get("input_views") or ()) for row in rows for run in row.runs}) > 1:
        found.append(f"the systems do not look through the same cameras; input views: {views}.")
    found += [*_other_data(table), *_trained_on(table)]
    broken = [str(run.folder) for run in table.runs if run.metrics.get("finite") is False]
    if broken:
        found.append(
            "some predictions are not finite; as images they count as black, while errors of particles and bodies "
            f"leave them out, and paired differences leave them out for both: {', '.join(broken)}."
        )
    bare = [str(run.folder) for run in table.runs if not run.samples]
    if bare:
        found.append(f"no arrays.npz, hence no paired differences and no interval over seeds: {', '.join(bare)}.")
    if not _same_references(table):
        found.append("the scores of the references differ between its runs, though data and protocol are the same.")
    return found


def _other_data(table: ComparisonTable) -> list[str]:
    """Say which runs are known to have been trained on another data set than the one they were evaluated on."""
    trained = [(run, (run.metrics.get("training") or {}).get("data_sha256")) for run in table.runs]
    other = [str(run.folder) for run, digest in trained if digest not in (None, table.data_sha256)]
    return [f"these were trained on another data set than they are evaluated on: {', '.join(other)}."] if other else []


def _trained_on(table: ComparisonTable) -> list[str]:
    """Say which runs were evaluated on what they were trained on, and of which that is not known."""
    seen = [(str(run.folder), (run.metrics.get("seen_in_training") or {}).get("trajectories")) for run in table.runs]
    some = [f"{folder} ({count} trajectories)" for folder, count in seen if count]
    unknown = [folder for folder, count in seen if count is None]
    found = [f"these were trained on what they are evaluated on: {', '.join(some)}."] if some else []
    if unknown:
        found.append(f"it is not known whether these were trained on what they are evaluated on: {', '.join(unknown)}.")
    return found


def _by_row(rows: Sequence[Row], pick: object) -> str:
    assert callable(pick)
    return "; ".join(f"{row.system} {' and '.join(str(value) for value in pick(row))}" for row in rows)


def _measured_times(rows: Sequence[Row]) -> list[str]:
    clocks = {run.clock for row in rows for run in row.runs if run.time is not None}
    if len(clocks) > 1:
        return [f"training times were measured with different clocks ({', '.join(sorted(clocks))})."]
    times: Mapping[str, list[float]] = {
        row.system: [run.minutes for run in row.runs if run.minutes is not None] for row in rows
    }
    means = {name: sum(values) / len(values) for name, values in times.items() if values}
    if means and max(means.values()) > (1 + _TIME_TOLERANCE) * min(means.values()):
        shown = ", ".join(f"{name} {value:.1f} min" for name, value in means.items())
        return [f"the systems trained for different times, though their budgets are the same: {shown}."]
    return []


def _budget_use(table: ComparisonTable) -> list[str]:
    """Say which runs with a time limit do not say what they took, or ended long before."""
    limited = [(run, run.minutes_allowed) for run in table.runs if run.minutes_allowed is not None]
    silent = [str(run.folder) for run, _ in limited if run.minutes is None]
    short = [
        f"{run.folder} ({run.minutes:.1f} of {allowed:g} min)"
        for run, allowed in limited
        if allowed is not None and run.minutes is not None and run.minutes < _USED * allowed
    ]
    found = [f"it is not known how long these trained: {', '.join(silent)}."] if silent else []
    return [*found, f"these ended before their time budget: {', '.join(short)}."] if short else found


def _differing_pace(table: ComparisonTable) -> list[str]:
    """With a time limit, what computes faster learns more: threads, workers, caches, devices, machines."""
    limited = [row for row in table.main_rows if any(run.minutes_allowed is not None for run in row.runs)]
    found = []
    for key in PACE:
        values = {row.system: [comparable_settings(run).get(key) for run in row.runs] for row in limited}
        if len({str(value) for given in values.values() for value in given}) > 1:
            each = "; ".join(
                f"{name} {' and '.join(dict.fromkeys(shown(key, value) for value in given))}"
                for name, given in values.items()
            )
            found.append(f"under a time budget, the runs did not compute alike: {each}.")
    machines = {run.machine for row in limited for run in row.runs if run.machine is not None}
    if len(machines) > 1:
        named = _by_row(limited, lambda row: sorted({str(run.machine) for run in row.runs}))
        found.append(f"under a time budget, the runs were made on different machines: {named}.")
    return found


def _same_references(table: ComparisonTable) -> bool:
    for source in REFERENCES:
        summaries = [metric(HEADLINE).summary(run.metrics, source) for run in table.runs]
        known = [summary["mean"] for summary in summaries if summary is not None]
        if known and max(known) - min(known) > _SAME_REFERENCE:
            return False
    return True
