"""What more training would bring: power laws through the points of ``motion_curve.py``, and a figure of both.

``python -m docs.results.studies.motion_law CURVE.json OUT.json OUT.png`` fits, for each training and each of ``STEPS``
steps ahead, error = scale * (clips / 1000) ** -exponent, by least squares of logarithms. Clips are updates times the
clips of an update: 304 updates of 16 clips did as well as 1,733 of 4 (docs/notes.md). ``PAPER_CLIPS`` is the paper's
training. There is no floor in the law: points of minutes cannot tell one from none. Two numbers tell how far a law can
be believed: ``range`` is the span of that prediction when each point in turn is left out, and ``held_out`` what a law
through the first half of the clips says of the last point, beside that point.

A law says nothing about a rate that falls to its end: compare trainings at their ends, and points within one only where
the rate was constant.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.plots import COLORS, GRID, INK
from vpd_lightning.files import AtomicPath

STEPS = (1, 4, 8, 16)
MIN_POINTS = 4
PAPER_CLIPS = 400_000 * 16


def fit(clips: Sequence[float], errors: Sequence[float]) -> tuple[float, float] | None:
    """Return scale and exponent; None for fewer than ``MIN_POINTS`` points."""
    if len(clips) < MIN_POINTS:
        return None
    slope, offset = np.polyfit(np.log(np.asarray(clips) / 1000), np.log(np.asarray(errors)), 1)
    return float(np.exp(offset)), -float(slope)


def predicted(law: tuple[float, float], clips: float) -> float:
    """Return the error after so many clips."""
    scale, exponent = law
    return float(scale * (clips / 1000) ** -exponent)


def described(clips: Sequence[float], errors: Sequence[float]) -> dict[str, Any] | None:
    """Return the law through points in the order of their clips, and how far it can be believed."""
    law = fit(clips, errors)
    if law is None:
        return None
    found: dict[str, Any] = {
        "scale": law[0],
        "exponent": law[1],
        "relative_residual": float(
            np.sqrt(np.mean([(predicted(law, at) / error - 1) ** 2 for at, error in zip(clips, errors, strict=True)]))
        ),
        "at_paper_clips": predicted(law, PAPER_CLIPS),
    }
    without = [
        fit([*clips[:place], *clips[place + 1 :]], [*errors[:place], *errors[place + 1 :]])
        for place in range(len(clips))
    ]
    ends = [predicted(each, PAPER_CLIPS) for each in without if each is not None]
    if ends:
        found["range"] = [min(ends), max(ends)]
    early = [place for place, at in enumerate(clips) if at <= clips[-1] / 2]
    half = fit([clips[place] for place in early], [errors[place] for place in early])
    if half is not None:
        found["held_out"] = {"predicted": predicted(half, clips[-1]), "measured": errors[-1]}
    return found


def laws(trainings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the law of each training and horizon, and what its last point cost."""
    found: dict[str, Any] = {}
    for name, training in trainings.items():
        points = sorted(training["points"].values(), key=lambda point: point["updates"])
        clips = [point["updates"] * point["clips_per_update"] for point in points]
        found[name] = {
            "parameters_of_dynamics": points[-1]["parameters_of_dynamics"],
            "updates": points[-1]["updates"],
            "seconds": points[-1]["seconds"],
            "laws": {
                str(step): described(clips, [point["centroid_error_cm"]["model"][str(step)] for point in points])
                for step in STEPS
            },
        }
    return found


def draw(trainings: Mapping[str, Any], found: Mapping[str, Any], out: Path) -> None:
    """Draw points and laws against clips (above) and against processor time (below)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot, ticker

    figure, axes = pyplot.subplots(2, len(STEPS), figsize=(13, 7), sharex="row", sharey="col", layout="constrained")
    for color, (name, training) in zip(COLORS, trainings.items(), strict=False):
        points = sorted(training["points"].values(), key=lambda point: point["updates"])
        clips = [point["updates"] * point["clips_per_update"] for point in points]
        minutes = [point["seconds"] / 60 for point in points]
        for column, step in enumerate(STEPS):
            errors = [point["centroid_error_cm"]["model"][str(step)] for point in points]
            axes[0, column].plot(clips, errors, "o", color=color, markersize=4, label=name)
            axes[1, column].plot(minutes, errors, "o-", color=color, markersize=4, linewidth=1)
            law = found[name]["laws"][str(step)]
            if law is not None:
                at = np.geomspace(clips[0], 4 * clips[-1], 100)
                line = [predicted((law["scale"], law["exponent"]), each) for each in at]
                axes[0, column].plot(at, line, color=color, linewidth=1)
    references = next(iter(next(iter(trainings.values()))["points"].values()))["centroid_error_cm"]
    for column, step in enumerate(STEPS):
        for row in (0, 1):
            axis = axes[row, column]
            for reference, style in (("nothing_moves", ":"), ("best_constant", "--")):
                label = reference.replace("_", " ") if row == 0 else None
                axis.axhline(references[reference][str(step)], color=INK, linestyle=style, linewidth=1, label=label)
            axis.set(xscale="log", yscale="log")
            for each, subs in ((axis.xaxis, (1.0, 3.0)), (axis.yaxis, (1.0, 2.0, 5.0))):
                each.set_major_locator(ticker.LogLocator(subs=subs))
                each.set_major_formatter(ticker.StrMethodFormatter("{x:,g}"))
                each.set_minor_formatter(ticker.NullFormatter())
            axis.grid(color=GRID)
            axis.set_axisbelow(True)
        axes[0, column].set(title=f"after {step} step{'s' if step > 1 else ''}", xlabel="clips that were trained on")
        axes[1, column].set(xlabel="minutes of a core, dynamics alone")
    for row in (0, 1):
        axes[row, 0].set(ylabel="error of the block's centre (cm)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    figure.savefig(out, dpi=100)
    pyplot.close(figure)


def main(arguments: Sequence[str]) -> int:
    """Fit and draw the trainings of a file."""
    curve, out, picture = map(Path, arguments)
    trainings = json.loads(curve.read_text())["trainings"]
    found = laws(trainings)
    with AtomicPath(out) as part:
        part.write_text(json.dumps(found, indent=1) + "\n")
    draw(trainings, found, picture)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
