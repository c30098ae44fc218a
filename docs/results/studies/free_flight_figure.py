"""The stages of VPD taken apart, as one picture: how far each ball's centre is from the truth as each row learns.

``python -m docs.results.studies.free_flight_figure docs/results/free_flight.json docs/images/free_flight.png``
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.plots import COLORS, GRID, INK, MARKERS

LINKS = {
    "targets": "graph network alone, from true displacements",
    "ready": "from pixels, renderer that draws true motion",
    "stills": "from pixels, renderer of single frames (staged)",
    "own": "from pixels, all stages together (paper)",
}
STEPS = (1, 8)
REFERENCES = {"nothing_moves": "nothing moves", "best_constant": "best constant", "constant_velocity": "true velocity"}


def draw(rows: dict[str, Any], out: Path) -> None:
    """Draw the error after each of ``STEPS`` steps over updates; rows of one link share a colour."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = {name: row for name, row in rows.items() if "curve" in row}
    figure, axes = pyplot.subplots(1, len(STEPS), figsize=(11, 5.2), layout="constrained")
    for step, axis in zip(STEPS, axes, strict=True):
        for number, (name, row) in enumerate(rows.items()):
            link = row["row"]["link"]
            curve = {int(update): found[f"step_{step}_cm"]["centre"] for update, found in row["curve"].items()}
            axis.plot(
                list(curve), list(curve.values()), marker=MARKERS[number % len(MARKERS)], markersize=5,
                color=COLORS[list(LINKS).index(link)], label=name,
            )  # fmt: skip
        last = next(iter(rows.values()))["curve"]
        for (key, title), style in zip(REFERENCES.items(), (":", "-.", "--"), strict=True):
            axis.axhline(last[max(last, key=int)][f"step_{step}_cm"][key], color=INK, linestyle=style, label=title)
        axis.set(
            xlabel="updates of 8 clips",
            ylabel="distance of a ball's centre from the truth (cm)",
            title="after one step" if step == 1 else f"after {step} steps",
            ylim=(0, None),
        )
        axis.grid(color=GRID)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    figure.suptitle("Colours: " + "; ".join(f"{i + 1} {title}" for i, title in enumerate(LINKS.values())), fontsize=8)
    figure.savefig(out, dpi=110)
    pyplot.close(figure)


def main(arguments: Sequence[str]) -> int:
    """Draw the rows of a file."""
    draw(json.loads(Path(arguments[0]).read_text()), Path(arguments[1]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
