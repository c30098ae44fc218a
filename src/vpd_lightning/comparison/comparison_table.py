"""Runs brought together: one table per data set and protocol, one row per system and setting, seeds in the row."""

import hashlib
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from vpd_lightning.comparison.bootstrap import Estimate, MetricSamples, estimate, stacked
from vpd_lightning.comparison.run import Run
from vpd_lightning.comparison.settings import (
    TRAJECTORIES,
    comparable,
    comparable_settings,
    differing,
    label,
    naming_keys,
)
from vpd_lightning.metrics.metric_info import MetricInfo
from vpd_lightning.metrics.registry import compared, metric
from vpd_lightning.release.system_notes import COLORS

EXPERIMENTS = (
    "mujoco_block", "deformable_block", "deformable_multi", "deformable_collision", "movi_a", "movi_b", "movi_c",
    "movi_a_high", "movi_c_high",
)  # fmt: skip

Groups = dict[tuple[object, ...], list[Run]]


@dataclass(frozen=True, eq=False)
class Row:
    """All seeds of one system in one setting; ``name`` tells it from the other rows of its table.

    ``settings`` are those that differ among the rows of its system, ``is_main`` marks the one that stands for it.
    """

    system: str
    name: str
    settings: Mapping[str, Hashable]
    runs: tuple[Run, ...]
    is_main: bool

    def samples(self, name: str, source: str = "model") -> MetricSamples | None:
        """What all seeds measured by a metric; None unless each of them did."""
        parts = [run.samples.get((source, name)) for run in self.runs]
        known = [part for part in parts if part is not None]
        if len(known) < len(parts) or len({part[0].shape for part in known}) != 1:
            return None
        return stacked(known)

    def estimate(self, name: str) -> Estimate | None:
        """Mean over the seeds of a metric's printed means, with the interval that the arrays give."""
        return self._estimates[name]

    @cached_property
    def _estimates(self) -> dict[str, Estimate | None]:
        return {info.name: self._estimate(info) for info in compared()}

    def _estimate(self, info: MetricInfo) -> Estimate | None:
        summaries = [info.summary(run.metrics) for run in self.runs]
        means = [summary["mean"] for summary in summaries if summary is not None]
        if len(means) < len(self.runs):
            return None
        samples = self.samples(info.name)
        found = estimate(samples, self.runs[0].num_bootstrap) if samples is not None else None
        printed = summaries[0]["ci95"] if len(means) == 1 and summaries[0] else None
        interval = found.interval if found else tuple(printed) if printed else None
        return Estimate(sum(means) / len(means), interval)

    @property
    def milliseconds_per_frame(self) -> float | None:
        """Mean over the seeds of what a predicted picture took; None unless each of them says it."""
        known = [run.milliseconds_per_frame for run in self.runs]
        times = [time for time in known if time is not None]
        return sum(times) / len(times) if len(times) == len(known) else None

    def per_step(self, name: str) -> list[float | None]:
        """Mean over the seeds of each step's printed mean; empty where there is none."""
        summaries = [metric(name).summary(run.metrics) for run in self.runs]
        curves = [summary.get("per_step") or [] for summary in summaries if summary is not None]
        if len(curves) < len(self.runs) or len({len(curve) for curve in curves}) != 1:
            return []
        return [None if None in values else sum(values) / len(values) for values in zip(*curves, strict=True)]


@dataclass(frozen=True)
class ComparisonTable:
    """The rows that may be compared: same experiment, same bytes of data, same protocol."""

    experiment: str
    title: str
    data_sha256: str
    rows: tuple[Row, ...]

    @cached_property
    def main_rows(self) -> tuple[Row, ...]:
        """One row per system."""
        return tuple(row for row in self.rows if row.is_main)

    @property
    def runs(self) -> list[Run]:
        """All runs of the table."""
        return [run for row in self.rows for run in row.runs]

    @property
    def file_name(self) -> str:
        """The title as files are named."""
        return "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in self.title)

    def reference(self, source: str, name: str) -> Estimate | None:
        """The score of ``copy_last`` or ``train_mean``, which is that of the first run that has it."""
        found = (metric(name).summary(run.metrics, source) for run in self.runs)
        summary = next((one for one in found if one is not None), None)
        if summary is None:
            return None
        interval = summary.get("ci95")
        return Estimate(summary["mean"], tuple(interval) if interval else None)

    def reference_samples(self, source: str, name: str) -> MetricSamples | None:
        """What was measured of a reference, as that of one seed."""
        found = (run.samples.get((source, name)) for run in self.runs)
        part = next((one for one in found if one is not None), None)
        return None if part is None else stacked([part])


def comparison_tables(runs: Sequence[Run]) -> list[ComparisonTable]:
    """Bring runs together. Runs on other data or under another protocol get a table of their own."""
    groups: dict[tuple[str, str, str], list[Run]] = {}
    for run in sorted(runs, key=lambda run: (_rank(EXPERIMENTS, run.experiment), run.data_sha256, run.protocol)):
        groups.setdefault((run.experiment, run.data_sha256, run.protocol), []).append(run)
    compared: dict[object, set[tuple[str, str]]] = {}
    for run in runs:
        compared.setdefault(run.config.get("sweep_name"), set()).add((run.experiment, run.system))
    reach = {sweep: len(places) for sweep, places in compared.items()}
    tables = []
    for (experiment, data_sha256, protocol), group in groups.items():
        same_name = [key for key in groups if key[0] == experiment]
        other_data, other_protocol = (len({key[i] for key in same_name}) > 1 for i in (1, 2))
        title = experiment
        title += f"-data-{data_sha256[:6]}" if other_data else ""
        title += f"-protocol-{hashlib.sha256(protocol.encode()).hexdigest()[:6]}" if other_protocol else ""
        tables.append(ComparisonTable(experiment, title, data_sha256, tuple(_rows(group, reach))))
    return tables


def _rows(runs: Sequence[Run], reach: Mapping[object, int]) -> list[Row]:
    rows = []
    shared: dict[str, set[str]] = {}
    for run in runs:
        shared.setdefault(run.declared_budget, set()).add(run.system)
    budgets = {budget: len(systems) for budget, systems in shared.items()}
    for system in sorted({run.system for run in runs}, key=system_order):
        settings = {id(run): comparable_settings(run) for run in runs if run.system == system}
        keys = differing(list(settings.values()))
        names = naming_keys(list(settings.values()))
        groups: Groups = {}
        for run in runs:
            if run.system == system:
                groups.setdefault(tuple(comparable(settings[id(run)], key) for key in keys), []).append(run)
        placed = sorted(groups.items(), key=lambda item: _place(settings[id(item[1][0])], names))
        main = max(placed, key=lambda item: _weight(item, groups, reach, budgets))[0]
        for group, members in placed:
            own = settings[id(members[0])]
            words = label(own, names)
            name = f"{system} ({words})" if words else system
            ordered = tuple(sorted(members, key=lambda run: run.seed))
            rows.append(Row(system, name, {key: own[key] for key in keys if key in own}, ordered, group == main))
    return rows


def _place(settings: Mapping[str, Hashable], names: Sequence[str]) -> list[tuple[int, float, str]]:
    """Sort numbers by size, lists by length, and null (all there is) last."""
    places = []
    for name in names:
        value = settings.get(name)
        if isinstance(value, int | float):
            places.append((0, float(value), ""))
        else:
            places.append((2, 0.0, "") if value is None else (1, float(len(str(value))), str(value)))
    return places


def _weight(
    item: tuple[tuple[object, ...], list[Run]],
    groups: Groups,
    reach: Mapping[object, int],
    budgets: Mapping[str, int],
) -> tuple:
    """What makes a setting stand for its system; the first that tells two apart counts.

    It was evaluated as it was trained; it had the budget that most systems share, which ``budgets`` counts; it is of
    the sweep (None: of no sweep) that goes over most systems and data
    sets, which ``reach`` counts; it has most seeds; it is of no sweep; it differs least from the others, as what
    several sweeps start from does; it has most data.
    """
    values, runs = item
    sweeps = {run.config.get("sweep_name") for run in runs}
    count = comparable_settings(runs[0]).get(TRAJECTORIES)
    return (
        not runs[0].asked_to_differ,
        max(budgets[run.declared_budget] for run in runs),
        max(reach[sweep] for sweep in sweeps),
        len(runs),
        None in sweeps,
        -sum(own != other for group in groups for own, other in zip(values, group, strict=True)),
        float(count) if isinstance(count, int | float) else float("inf"),
    )


def system_order(name: str) -> tuple[int, str]:
    """The place of a system in tables, as a key to sort by: that of the paper's table; others follow by name."""
    return _rank(tuple(COLORS), name)


def _rank(order: Sequence[str], name: str) -> tuple[int, str]:
    """A variant stands behind what it varies: vpd_two_steps behind vpd."""
    known = [known for known in order if name == known or name.startswith(f"{known}_")]
    return (order.index(max(known, key=len)) if known else len(order)), name
