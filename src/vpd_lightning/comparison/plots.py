"""The plots of a report: scores over the rollout, and over a setting that was swept."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator, ScalarFormatter

from vpd_lightning.comparison.bootstrap import step_band
from vpd_lightning.comparison.comparison_table import ComparisonTable, Row
from vpd_lightning.comparison.sweep import Sweep
from vpd_lightning.comparison.tables import TITLES
from vpd_lightning.files import AtomicPath
from vpd_lightning.metrics.metric_info import MetricInfo
from vpd_lightning.metrics.registry import HEADLINE, REFERENCES, image_metrics, metric, paired, scores
from vpd_lightning.release.system_notes import COLORS

_SPARE = ("#7f3c8d", "#a6761d", "#e31a1c", "#33a02c", "#1b1b6f", "#b15928")
_REFERENCE_STYLES: dict[str, dict[str, Any]] = {
    "copy_last": {"color": "#555555", "linestyle": "--", "linewidth": 1.2},
    "train_mean": {"color": "#999999", "linestyle": ":", "linewidth": 1.6},
}
_MARKERS = "os^Dv<>Pph*X"
_BAND_ALPHA = 0.15
_MAX_BANDS = 8  # more hide each other


def rollout_plot(path: Path, table: ComparisonTable) -> bool:
    """Draw every system's scores over the predicted step, with 95 % bands; False: there is nothing to draw."""
    rows = table.main_rows
    infos = [info for info in image_metrics() if any(row.per_step(info.name) for row in rows)]
    return _curves(path, table, infos, [(row, row.system, _color(row.system, i)) for i, row in enumerate(rows)])


def settings_plot(path: Path, table: ComparisonTable, system: str) -> bool:
    """Draw the scores of every setting of one system over the predicted step."""
    rows = [row for row in table.rows if row.system == system]
    colors = [*COLORS.values(), *_SPARE]
    named = [(row, row.name, colors[i % len(colors)]) for i, row in enumerate(rows)]
    infos = [info for info in image_metrics() if any(row.per_step(info.name) for row in rows)]
    return _curves(path, table, infos, named)


def overview_plot(path: Path, tables: Sequence[ComparisonTable]) -> bool:
    """Draw the headline metric over the predicted step, one panel per data set (the paper's figure)."""
    columns = min(len(tables), 4)
    rows = -(-len(tables) // columns)
    figure = Figure(figsize=(4.0 * columns + 1.6, 3.3 * rows), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for panel, table in zip(panels, tables, strict=False):
        lines = [(row, row.system, _color(row.system, i)) for i, row in enumerate(table.main_rows)]
        _curve_panel(panel, table, metric(HEADLINE), lines, has_bands=len(lines) <= _MAX_BANDS)
        panel.set_title(table.title, fontsize=11)
    for panel in panels[len(tables) :]:
        panel.set_axis_off()
    _legend(figure, panels)
    _save(figure, path)
    return True


def sweep_plot(path: Path, table: ComparisonTable, sweep: Sweep) -> bool:
    """Draw scores over a swept setting: a line per system (and further settings), intervals as bars."""
    infos = [info for info in scores() if any(row.estimate(info.name) for row, _ in sweep.points)]
    if not infos:
        return False
    figure = Figure(figsize=(4.2 * len(infos) + 1.8, 3.5), layout="constrained")
    panels = list(figure.subplots(1, len(infos), squeeze=False)[0])
    for panel, info in zip(panels, infos, strict=True):
        for number, (name, points) in enumerate(sweep.lines.items()):
            _sweep_line(panel, info, name, points, number, is_joined=sweep.is_joined)
        for source in REFERENCES:
            reference = table.reference(source, info.name)
            if reference is not None:
                panel.axhline(info.scale * reference.mean, label=TITLES[source], **_REFERENCE_STYLES[source])
        _sweep_axis(panel, sweep)
        panel.set_ylabel(info.label)
        panel.grid(alpha=0.3)
    figure.suptitle(table.title, fontsize=11)
    _legend(figure, panels)
    _save(figure, path)
    return True


def time_error_plot(path: Path, table: ComparisonTable) -> bool:
    """Draw every setting's scores and motion errors over what a predicted picture costs; intervals as bars.

    False: there is nothing to draw.
    """
    timed = [row for row in table.rows if row.milliseconds_per_frame]
    infos = [info for info in paired() if any(row.estimate(info.name) for row in timed)]
    if not infos:
        return False
    figure = Figure(figsize=(4.2 * len(infos) + 1.8, 3.5), layout="constrained")
    panels = list(figure.subplots(1, len(infos), squeeze=False)[0])
    for panel, info in zip(panels, infos, strict=True):
        for number, row in enumerate(timed):
            points = [(row, row.milliseconds_per_frame or 0.0)]
            _sweep_line(panel, info, row.name, points, number, is_joined=False)
        for source in REFERENCES:
            reference = table.reference(source, info.name)
            if reference is not None:
                panel.axhline(info.scale * reference.mean, label=TITLES[source], **_REFERENCE_STYLES[source])
        panel.set_xscale("log")
        panel.set_xlabel("milliseconds per predicted picture")
        panel.set_ylabel(info.label)
        panel.grid(alpha=0.3, which="both")
    figure.suptitle(table.title, fontsize=11)
    _legend(figure, panels)
    _save(figure, path)
    return True


def _curves(
    path: Path, table: ComparisonTable, infos: Sequence[MetricInfo], lines: Sequence[tuple[Row, str, str]]
) -> bool:
    if not infos:
        return False
    figure = Figure(figsize=(4.2 * len(infos) + 1.8, 3.5), layout="constrained")
    panels = list(figure.subplots(1, len(infos), squeeze=False)[0])
    for panel, info in zip(panels, infos, strict=True):
        _curve_panel(panel, table, info, lines, has_bands=len(lines) <= _MAX_BANDS)
    figure.suptitle(table.title, fontsize=11)
    _legend(figure, panels)
    _save(figure, path)
    return True


def _curve_panel(
    panel: Axes, table: ComparisonTable, info: MetricInfo, lines: Sequence[tuple[Row, str, str]], has_bands: bool
) -> None:
    for row, name, color in lines:
        curve = _numbers(row.per_step(info.name))
        steps = np.arange(1, len(curve) + 1)
        marker = "o" if len(curve) == 1 else None
        panel.plot(steps, info.scale * curve, color=color, linewidth=1.8, label=name, marker=marker)
        samples = row.samples(info.name)
        if has_bands and samples is not None and samples.total.shape[2] == len(curve):
            low, high = info.scale * step_band(samples, row.runs[0].num_bootstrap)
            panel.fill_between(steps, low, high, color=color, alpha=_BAND_ALPHA, linewidth=0)
    for source in REFERENCES:
        summary = info.summary(table.runs[0].metrics, source)
        if summary is not None and info.better != "one":
            curve = _numbers(summary["per_step"])
            style = _REFERENCE_STYLES[source]
            panel.plot(np.arange(1, len(curve) + 1), info.scale * curve, label=TITLES[source], **style)
    if info.better == "one":
        panel.axhline(1.0, color="#333333", linewidth=0.8)
    panel.set_xlabel("predicted step")
    panel.set_ylabel(info.label)
    panel.grid(alpha=0.3)
    panel.xaxis.set_major_locator(MaxNLocator(integer=True))


def _sweep_line(
    panel: Axes, info: MetricInfo, name: str, points: Sequence[tuple[Row, float]], number: int, is_joined: bool
) -> None:
    known = [(x, found) for row, x in points if (found := row.estimate(info.name)) is not None]
    if not known:
        return
    places, means = [x for x, _ in known], [info.scale * found.mean for _, found in known]
    ends = [found.interval or (found.mean, found.mean) for _, found in known]
    below = [max(mean - info.scale * low, 0.0) for mean, (low, _) in zip(means, ends, strict=True)]
    above = [max(info.scale * high - mean, 0.0) for mean, (_, high) in zip(means, ends, strict=True)]
    style: dict[str, Any] = {"color": _color(points[0][0].system, number) if "(" not in name else _spare(number)}
    style["linestyle"] = "-" if is_joined else "none"
    panel.errorbar(
        places, means, yerr=[below, above], marker=_MARKERS[number % len(_MARKERS)], linewidth=1.8, capsize=3,
        markersize=5, label=name, **style,
    )  # fmt: skip


def _sweep_axis(panel: Axes, sweep: Sweep) -> None:
    places = sorted({x for _, x in sweep.points})
    if sweep.names:
        panel.set_xticks(range(len(sweep.names)), sweep.names, rotation=20, ha="right", fontsize=8)
    elif sweep.is_logarithmic:
        panel.set_xscale("log", base=2)
        panel.xaxis.set_major_locator(FixedLocator(places))
        panel.xaxis.set_minor_locator(NullLocator())
        panel.xaxis.set_major_formatter(ScalarFormatter())
    else:
        panel.set_xticks(places)
    panel.set_xlabel(sweep.title)


def _legend(figure: Figure, panels: Sequence[Axes]) -> None:
    """One legend for all panels, beside them."""
    entries = {
        label: handle for panel in panels for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    names = sorted(entries, key=lambda name: name in TITLES.values())
    if entries:
        figure.legend([entries[name] for name in names], names, loc="outside right center", fontsize=8, frameon=False)


def _color(system: str, number: int) -> str:
    return COLORS.get(system) or _spare(number)


def _spare(number: int) -> str:
    return _SPARE[number % len(_SPARE)]


def _numbers(values: Sequence[float | None]) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _save(figure: Figure, path: Path) -> None:
    with AtomicPath(path) as partial, partial.open("wb") as stream:
        figure.savefig(stream, format="png", dpi=130)
