"""Plots of the suites: bars, time-error curves with the Pareto front, log-log scaling with fitted exponents."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.measuring import Row

INK, GRID = "#333333", "#dddddd"
COLORS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8c6d1f", "#56b4e9", "#7f3c8d", "#e6ab02", "#666666", "#a6761d",
)  # fmt: skip
MARKERS = "os^Dv<>Pph*X"


@dataclass(frozen=True)
class Point:
    """One setting of a knob: seconds, error (0 or more), PSNR where there is truth, and the value's name."""

    label: str
    seconds: float
    error: float
    psnr: float | None
    is_default: bool = False


@dataclass(frozen=True)
class Mark:
    """A trained model in a plot of quality over time: PSNR in dB, and its standard error; ``kind`` says of what."""

    name: str
    kind: str
    seconds: float
    psnr: float
    spread: float


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """Return the points that no other point beats in both time and error, from fast to slow."""
    front: list[Point] = []
    for point in sorted(points, key=lambda p: (p.seconds, p.error)):
        if not front or point.error < front[-1].error:
            front.append(point)
    return front


def fitted_exponent(sizes: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """Return (exponent, factor) of the power law that fits best in logarithms.

    Raises:
        ValueError: fewer than two sizes, or a number that has no logarithm.
    """
    if len(sizes) < 2 or min([*sizes, *values]) <= 0:
        raise ValueError("A power law needs two sizes or more, and numbers above 0.")
    x, y = [math.log(s) for s in sizes], [math.log(v) for v in values]
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    slope = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / sum((a - mean_x) ** 2 for a in x)
    return slope, math.exp(mean_y - slope * mean_x)


def bars(rows: Sequence[Row], title: str, path: Path) -> None:
    """Draw the times of rows as horizontal bars on a logarithmic axis, with ratio and memory written beside them."""
    pyplot = _pyplot()
    rows = [item for item in rows if item.seconds]
    figure, axes = pyplot.subplots(figsize=(9, 1.2 + 0.36 * len(rows)), layout="constrained")
    seconds = [1000 * (item.seconds or 0.0) for item in rows]
    kinds = list(dict.fromkeys(item.baseline for item in rows))
    axes.barh(
        range(len(rows)), seconds, color=[COLORS[kinds.index(r.baseline) % len(COLORS)] for r in rows], height=0.7
    )
    axes.set_yticks(range(len(rows)), [item.name for item in rows], fontsize=9)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlim(min(seconds) / 2, max(seconds) * 30)  # room for what is written beside the bars
    axes.set_xlabel("milliseconds")
    axes.set_title(title, fontsize=11, loc="left")
    for number, item in enumerate(rows):
        words = [f"{_duration(item.seconds or 0.0)}"]
        if item.ratio is not None:
            words.append(f"{item.ratio:.2f}x {item.baseline}")
        if item.peak_bytes:
            words.append(f"{item.peak_bytes / 2**20:.0f} MiB")
        axes.text(seconds[number] * 1.1, number, ", ".join(words), va="center", fontsize=8, color=INK)
    _finish(figure, [axes], path)


def time_error(panels: Mapping[str, Mapping[str, Sequence[Point]]], path: Path) -> None:
    """Draw, for each model, error (left) and PSNR (right) over time; one curve per knob.

    The Pareto front of all points is a grey line, the default a star.
    """
    pyplot = _pyplot()
    figure, grid = pyplot.subplots(len(panels), 2, figsize=(15, 5.4 * len(panels)), layout="constrained", squeeze=False)
    for (title, knobs), (left, right) in zip(panels.items(), grid, strict=True):
        every = [point for points in knobs.values() for point in points]
        front = pareto_front(every)
        lowest = min((p.error for p in every if p.error > 0), default=1e-9)
        steps = [p.seconds * 1000 for p in front]
        left.step(steps, [max(p.error, lowest) for p in front], where="post", color="#bbbbbb", lw=5, zorder=0)
        for number, (knob, points) in enumerate(knobs.items()):
            style = {
                "color": COLORS[number % len(COLORS)], "marker": MARKERS[number % len(MARKERS)], "ms": 5, "lw": 1.2,
            }  # fmt: skip
            x = [1000 * p.seconds for p in points]
            left.plot(x, [max(p.error, lowest) for p in points], label=knob, **style)
            _name_ends(left, points, [max(p.error, lowest) for p in points], style["color"])
            seen = [p for p in points if p.psnr is not None]
            right.plot([1000 * p.seconds for p in seen], [p.psnr for p in seen], **style)
            _name_ends(right, seen, [p.psnr or 0.0 for p in seen], style["color"])
        default = next((p for p in every if p.is_default), None)
        if default is not None:
            star = {"ms": 17, "color": "black", "mfc": "gold", "zorder": 9}
            left.plot([1000 * default.seconds], [max(default.error, lowest)], "*", label="default", **star)
            if default.psnr is not None:
                right.plot([1000 * default.seconds], [default.psnr], "*", **star)
        for axes in (left, right):
            axes.set_xscale("log")
            _plain_numbers(axes.xaxis)
            axes.set_xlabel("time, milliseconds")
        left.plot([], [], color="#bbbbbb", lw=5, label="Pareto front")
        left.set_yscale("log")
        left.set_ylabel("RMS error to the float64 reference")
        left.set_title(title, fontsize=11, loc="left")
        right.set_ylabel("PSNR to the recording, dB")
        if not any(p.psnr is not None for p in every):
            right.text(0.5, 0.5, "untrained: no PSNR", transform=right.transAxes, ha="center", color=INK)
        handles, labels = left.get_legend_handles_labels()
        right.legend(handles, labels, loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9, frameon=False)
    _finish(figure, grid.ravel(), path)


def quality_over_time(marks: Sequence[Mark], title: str, path: Path) -> None:
    """Draw PSNR over the time of a frame; a colour per name, an outline instead of a disc per kind behind the first."""
    pyplot = _pyplot()
    figure, axes = pyplot.subplots(figsize=(8, 5), layout="constrained")
    names, kinds = (list(dict.fromkeys(values)) for values in ([m.name for m in marks], [m.kind for m in marks]))
    for mark in marks:
        color = COLORS[names.index(mark.name) % len(COLORS)]
        number = kinds.index(mark.kind)
        style = {"color": color, "ms": 10, "mfc": "white" if number else color, "mew": 2, "capsize": 4}
        axes.errorbar(
            [1000 * mark.seconds], [mark.psnr], yerr=[mark.spread], fmt=MARKERS[number % len(MARKERS)], **style
        )
        if number == 0:
            words = {"xytext": (11, 6), "textcoords": "offset points", "fontsize": 10, "color": color}
            axes.annotate(mark.name, (1000 * mark.seconds, mark.psnr), **words)
    for number, kind in enumerate(kinds if len(kinds) > 1 else []):
        face = {"mfc": "white" if number else INK, "color": INK}
        axes.plot([], [], MARKERS[number % len(MARKERS)], label=kind, ms=9, mew=2, **face)
    if len(kinds) > 1:
        axes.legend(fontsize=9, frameon=False)
    axes.set_xscale("log")
    _plain_numbers(axes.xaxis)
    axes.margins(x=0.25, y=0.15)
    axes.set_xlabel("time of a frame, milliseconds")
    axes.set_ylabel("PSNR to the recording, dB")
    axes.set_title(title, fontsize=11, loc="left")
    _finish(figure, [axes], path)


def scaling(curves: Mapping[str, Mapping[str, tuple[Sequence[float], Sequence[float]]]], path: Path) -> None:
    """Draw panels (title with unit -> curves of (sizes, values)) on log-log axes; legends name fitted exponents."""
    pyplot = _pyplot()
    figure, grid = pyplot.subplots(
        1, len(curves), figsize=(5.6 * len(curves), 4.8), layout="constrained", squeeze=False
    )
    for (title, panel), axes in zip(curves.items(), grid[0], strict=True):
        for number, (name, (sizes, values)) in enumerate(panel.items()):
            color, label = COLORS[number % len(COLORS)], name
            kept = [(s, v) for s, v in zip(sizes, values, strict=True) if v > 0]
            if len(kept) >= 2:
                exponent, factor = fitted_exponent([s for s, _ in kept], [v for _, v in kept])
                label = f"{name}: N^{exponent:.2f}"
                axes.plot([s for s, _ in kept], [factor * s**exponent for s, _ in kept], ":", color=color, lw=1)
            style = {"marker": MARKERS[number % len(MARKERS)], "color": color, "ms": 5, "lw": 1.4}
            axes.plot([s for s, _ in kept], [v for _, v in kept], label=label, **style)
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
        _plain_numbers(axes.yaxis)
        axes.set_xlabel("particles")
        axes.set_title(title, fontsize=11, loc="left")
        axes.legend(fontsize=8.5, frameon=False)
    _finish(figure, grid[0], path)


def _name_ends(axes, points: Sequence[Point], heights: Sequence[float], color: str) -> None:
    """Write the first and the last value beside a curve; more words would hide the points."""
    for index in {0, len(points) - 1} if points else ():
        if points[index].is_default:
            continue
        where = (1000 * points[index].seconds, heights[index])
        axes.annotate(points[index].label, where, textcoords="offset points", xytext=(5, 5), fontsize=7.5, color=color)


def _plain_numbers(axis) -> None:
    """Write 1, 2, 5, 10 on a logarithmic axis instead of powers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _duration(seconds: float) -> str:
    return f"{seconds:.2f} s" if seconds >= 1 else f"{1000 * seconds:.3g} ms"


def _pyplot():
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def _finish(figure, panels, path: Path) -> None:
    for axes in panels:
        axes.grid(True, which="major", color=GRID, lw=0.6)
        axes.set_axisbelow(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    figure.savefig(path, dpi=130)
    _pyplot().close(figure)
