"""``report.md``: what stands where."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vpd_lightning.comparison.comparison_table import ComparisonTable
from vpd_lightning.comparison.horizons import horizon_tables
from vpd_lightning.comparison.sweep import Sweep
from vpd_lightning.comparison.tables import (
    differences_table,
    overview,
    settings_lists,
    settings_table,
    systems_table,
    winners,
)
from vpd_lightning.comparison.warnings import parted_experiments, table_warnings
from vpd_lightning.metrics.metric_info import MetricInfo
from vpd_lightning.metrics.registry import HEADLINE, blocks, compared, metric, scores

_READING = """\
## How to read the tables

- A score is the mean over all images of all held-out clips (`metrics.json`), then over the seeds. In brackets: its 95 %
  bootstrap interval. Each of the {bootstrap} resamples draws trajectories with replacement, the same for all systems,
  and seeds with replacement. With one seed it says nothing about other seeds; with two or three it understates them.
- **Bold**: the best system, whose interval no other one reaches. `~`: the best and those whose interval overlaps its
  interval ("within the interval"); none where training budgets differ. Paired differences, of the steps that both
  predict, can tell systems apart that intervals cannot.
{metrics}
- Budget: what a training was allowed; minutes: what it took, by the named clock; both with its pretraining. Steps:
  updates behind the evaluated weights, without those of a pretraining. Ms per picture: wall time of a clip's
  prediction, from input frames to pictures, over its pictures, on the machine of that evaluation, with what ran there.
- By predicted step: brackets hold the interval of that step; "less" rows are differences on the same trajectories.
- `-`: not known, or the system has no such thing."""


@dataclass(frozen=True)
class TableFiles:
    """The pictures of one table, by what they show; ``not_shown`` names rollouts that are missing, and why."""

    rollout: Path | None
    time_error: Path | None
    settings: Mapping[str, Path]
    sweeps: Sequence[tuple[Sweep, Path]]
    strips: Sequence[Path]
    films: Sequence[Path]
    not_shown: Sequence[tuple[Path, str]]


def page(
    title: str,
    tables: Sequence[ComparisonTable],
    files: Sequence[TableFiles],
    overview_picture: Path | None,
    left_out: Sequence[tuple[Path, str]],
) -> str:
    """Put the report together; pictures lie in the same folder."""
    num_runs = sum(len(table.runs) for table in tables)
    lines = [
        f"# {title}",
        "",
        f"{num_runs} run{'s' * (num_runs > 1)}, {len(left_out)} left out (listed at the end).",
        "",
    ]
    warnings = parted_experiments(tables)
    warnings += [f"{table.title}: {words}" for table in tables for words in table_warnings(table)]
    if warnings:
        lines += ["## Warnings", "", *(f"- {words}" for words in warnings), ""]
    bootstrap = max(table.runs[0].num_bootstrap for table in tables)
    meanings = "\n".join(f"- {info.label}: {info.description}." for info in compared())
    lines += [_READING.format(bootstrap=bootstrap, metrics=meanings), "", "## Overview", ""]
    for info in scores():
        if any(row.estimate(info.name) for table in tables for row in table.main_rows):
            lines += [*overview(tables, info), ""]
    lines += [f"- {table.title}: {row.name} stands for {row.system}." for table in tables for row in table.main_rows
              if row.name != row.system]  # fmt: skip
    lines += (
        ["", _picture(f"{metric(HEADLINE).title} over the rollout", overview_picture), ""] if overview_picture else [""]
    )
    for table, own in zip(tables, files, strict=True):
        lines += _table(table, own)
    lines += ["## Runs", "", *_runs(tables), "", "## Left out, and why", ""]
    lines += [f"- `{path}`: {why}" for path, why in left_out] or ["Nothing."]
    return "\n".join(_without_double_blanks(lines)) + "\n"


def _table(table: ComparisonTable, files: TableFiles) -> list[str]:
    protocol = table.runs[0].metrics["protocol"]
    facts = [
        f"{protocol[key]} {words}"
        for key, words in (
            ("num_trajectories", "held-out trajectories"),
            ("num_clips", "clips"),
            ("num_steps", "predicted steps"),
            ("num_views", "cameras"),
        )
        if protocol.get(key) is not None
    ]
    starts = protocol.get("start_frames")
    lines = [f"## {table.title}", "", f"{', '.join(facts)}; split {protocol.get('split')}, first frames {starts}; "
             f"data `{table.data_sha256[:12]}`.", ""]  # fmt: skip
    lines += [*(f"- **Warning:** {words}" for words in table_warnings(table)), "", *systems_table(table), ""]
    lines += _machines(table)
    for info in blocks():
        followed = _of_true_motion(table, info)
        if followed:
            words = f"What the true motion would give, since cameras put the particles there; {info.label}: {followed}."
            lines += [words, ""]
    if files.rollout:
        lines += [_picture("scores over the rollout", files.rollout), ""]
    if files.time_error:
        lines += [_picture("scores and errors over milliseconds per predicted picture", files.time_error), ""]
    best = winners(table)
    if best:
        lines += ["### Who is best", "", *best, ""]
    by_step = horizon_tables(table)
    if by_step:
        lines += ["### By predicted step", "", *by_step]
    paired = differences_table(table)
    if paired:
        words = "Mean differences on the same trajectories, with their intervals; one that holds 0 shows no difference."
        lines += ["### Paired differences", "", words, "", *paired, ""]
    settings = settings_table(table)
    if settings:
        lines += ["### Settings", "", *settings, "", "All that differs:", "", *settings_lists(table), ""]
    for sweep, path in files.sweeps:
        lines += [_picture(f"scores over {sweep.title}", path), ""]
        lines += [f"Not drawn: {row.name}, whose data set is not there to count." for row in sweep.not_placed]
    for system, path in files.settings.items():
        lines += ["", _picture(f"settings of {system} over the rollout", path)]
    if files.strips:
        lines += [
            "",
            "### Rollouts",
            "",
            *(_picture(path.stem.replace("_", " "), path) + "\n" for path in files.strips),
            *(f"- [{path.stem.replace('_', ' ')}]({path.name})" for path in files.films),
        ]
    lines += [f"- not shown: `{path}` ({why})" for path, why in files.not_shown]
    return [*lines, ""]


def _machines(table: ComparisonTable) -> list[str]:
    known = list(dict.fromkeys(run.machine for row in table.main_rows for run in row.runs if run.machine is not None))
    budgets = list(dict.fromkeys(run.declared_budget for row in table.main_rows for run in row.runs))
    return [f"Budget: {' and '.join(budgets)}; trained on {' and on '.join(known)}.", ""] if known else []


def _of_true_motion(table: ComparisonTable, info: MetricInfo) -> str:
    found = []
    for row in table.main_rows:
        means = [(run.metrics.get(info.name) or {}).get("true_motion") for run in row.runs]
        known = [mean for mean in means if mean is not None]
        if known:
            found.append(f"{row.name} {info.shown(sum(known) / len(known))}")
    return ", ".join(found)


def _runs(tables: Sequence[ComparisonTable]) -> list[str]:
    return [
        f"- {table.title}, {row.name}, seed {run.seed}: `{run.evaluation}`"
        for table in tables
        for row in table.rows
        for run in row.runs
    ]


def _picture(words: str, path: Path) -> str:
    return f"![{words}]({path.name})"


def _without_double_blanks(lines: Sequence[str]) -> list[str]:
    return [line for i, line in enumerate(lines) if line or (i > 0 and lines[i - 1])]
