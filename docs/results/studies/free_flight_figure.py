"""The stages of VPD taken apart, as one picture: how far a ball's centre is from the truth after each training.

``python -m docs.results.studies.free_flight_figure docs/results/free_flight.json docs/images/free_flight.png``
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.plots import COLORS, GRID, INK

LINKS = {
    "targets": "graph network alone, from true displacements",
    "ready": "from pixels, renderer that has drawn true motion",
    "stills": "from pixels, renderer that has drawn single frames",
    "own": "from pixels, all stages together",
}
STEPS = (1, 8)
REFERENCES = {"nothing_moves": (":", "nothing moves"), "constant_velocity": ("--", "true constant velocity")}


def draw(rows: dict[str, Any], out: Path) -> None:
    """Draw the last error of each row after each of ``STEPS`` steps, rows of one link in one colour.

    The best constant is left out: here it is within a hundredth of "nothing moves".
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    trained = [(name, row) for link in LINKS for name, row in rows.items() if row.get("row", {}).get("link") == link]
    last = {name: row["curve"][max(row["curve"], key=int)] for name, row in trained}
    figure, axes = pyplot.subplots(1, len(STEPS), figsize=(11, 5), sharey=True, layout="constrained")
    for step, axis in zip(STEPS, axes, strict=True):
        key = f"step_{step}_cm"
        for place, (name, row) in enumerate(trained):
            link, error = row["row"]["link"], last[name][key]["centre"]
            first = place == [each["row"]["link"] for _, each in trained].index(link)
            color = COLORS[list(LINKS).index(link)]
            axis.barh(place, error, color=color, label=LINKS[link] if first else None)
            axis.text(error, place, f" {error:.1f}", va="center", fontsize=8, color=INK)
        for reference, (style, title) in REFERENCES.items():
            axis.axvline(last[trained[0][0]][key][reference], color=INK, linestyle=style, linewidth=1, label=title)
        axis.set(
            xlabel="distance of a ball's centre from the truth (cm)",
            title="after one step" if step == 1 else f"after {step} steps",
            yticks=range(len(trained)), yticklabels=[name for name, _ in trained],
        )  # fmt: skip
        axis.grid(color=GRID, axis="x")
        axis.set_axisbelow(True)
    axes[0].invert_yaxis()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    figure.savefig(out, dpi=110)
    pyplot.close(figure)


def main(arguments: Sequence[str]) -> int:
    """Draw the rows of a file."""
    draw(json.loads(Path(arguments[0]).read_text()), Path(arguments[1]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
