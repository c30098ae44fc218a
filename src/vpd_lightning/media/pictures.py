"""Pictures in reports: curves over the steps, contact sheets of predictions, plots of particles."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from vpd_lightning.files import AtomicPath
from vpd_lightning.media.video import enlarge, error_image, framed, label_bar
from vpd_lightning.metrics.registry import (
    DRAWN,
    NOTHING_MOVES,
    TRUE_MOTION,
    TRUE_VELOCITY,
    referenced,
    references_of,
    scores,
)

_STYLES: dict[str, dict[str, Any]] = {
    "model": {"color": "#1f5fbf", "linewidth": 2.2, "label": "model"},
    "copy_last": {"color": "#d0762a", "linewidth": 1.4, "linestyle": "--", "label": "copy last input frame"},
    "train_mean": {"color": "#777777", "linewidth": 1.4, "linestyle": ":", "label": "training mean"},
}
_DRAWN_STYLES: dict[str, dict[str, Any]] = {
    NOTHING_MOVES: {"color": "#b04a8a", "linewidth": 1.2, "linestyle": "--"},
    TRUE_VELOCITY: {"color": "#b04a8a", "linewidth": 1.2, "linestyle": "-."},
    TRUE_MOTION: {"color": "#2a8a4a", "linewidth": 1.2},
}
_MOTION_STYLES: tuple[dict[str, Any], ...] = tuple(
    {key: value for key, value in style.items() if key != "label"} for style in _STYLES.values()
)


def write_curves(path: Path, table: Mapping[str, Sequence[float | None]]) -> None:
    """Draw the scores of images, and the errors of bodies beside what needs no model, over the predicted steps.

    ``table`` is that of ``evaluation.report.step_table``; a value that does not exist is None and leaves a gap.
    """
    motion = [info for info in referenced() if f"motion/{info.name}" in table]
    images = [info for info in scores() if any(value is not None for value in table.get(f"model/{info.name}", ()))]
    figure = Figure(figsize=(4.2 * (len(images) + len(motion)), 3.4), layout="constrained")
    axes = figure.subplots(1, len(images) + len(motion), squeeze=False)[0]
    for axis, info in zip(axes, images, strict=False):
        for source, style in _STYLES.items():
            curve = info.scale * _curve(table[f"{source}/{info.name}"])
            axis.plot(table["step"], curve, marker=_marker(table), **style)
        for source, style in _DRAWN_STYLES.items():
            if f"{source}/{info.name}" in table:
                curve = info.scale * _curve(table[f"{source}/{info.name}"])
                axis.plot(table["step"], curve, marker=_marker(table), label=f"{DRAWN[source]}, same renderer", **style)
        axis.set_title(info.label)
    for axis, info in zip(axes[len(images) :], motion, strict=True):
        blind = [other for other in references_of(info) if not other.sees_input]
        labels = {info.name: "model", **{other.name: other.title for other in blind}}
        for (name, label), style in zip(labels.items(), cycle(_MOTION_STYLES), strict=False):
            curve = info.scale * _curve(table[f"motion/{name}"])
            axis.plot(table["step"], curve, marker=_marker(table), label=label, **style)
        axis.set_title(info.label)
        axis.set_ylim(bottom=0)
        axis.legend(fontsize=8)
    for axis in axes:
        axis.set_xlabel("predicted step")
        axis.grid(alpha=0.3)
        axis.xaxis.get_major_locator().set_params(integer=True)
    axes[0].legend(fontsize=8)
    _save(figure, path)


def _curve(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _marker(table: Mapping[str, Sequence[float | None]]) -> str | None:
    return "o" if len(table["step"]) == 1 else None


def write_contact_sheet(
    path: Path,
    rows: Sequence[tuple[str, NDArray[np.uint8], NDArray[np.uint8]]],
    steps: Sequence[int],
    title: str,
) -> None:
    """Draw three lines of images (truth, prediction, error) for each (label, truth, prediction).

    Images are (time, height, width, 3); the columns are the chosen ``steps`` (from 1).
    """
    blocks = []
    for label, truth, pred in rows:
        chosen = [step - 1 for step in steps]
        lines = {
            "truth": [truth[i] for i in chosen],
            "prediction": [pred[i] for i in chosen],
            "error": [error_image(pred[i], truth[i]) for i in chosen],
        }
        picture = np.concatenate(
            [np.concatenate([framed(enlarge(image, 128)) for image in line], axis=1) for line in lines.values()]
        )
        side = _side_labels(list(lines), picture.shape[0])
        block = np.concatenate([side, picture], axis=1)
        blocks.append(np.concatenate([label_bar(label, block.shape[1]), block]))
    width = blocks[0].shape[1]
    heads = [label_bar(title, width), _column_labels(steps, width)]
    write_png(path, np.concatenate([*heads, *blocks]))


def write_view_sheet(path: Path, lines: Mapping[str, NDArray[np.uint8]], labels: Sequence[str], title: str) -> None:
    """Draw named lines of images (view, height, width, 3) below each other; a column is one view and has its label.

    More than four views go on in a further block.
    """
    blocks = []
    for first in range(0, len(labels), _COLUMNS):
        here = slice(first, first + _COLUMNS)
        rows = [np.concatenate([framed(enlarge(image)) for image in images[here]], axis=1) for images in lines.values()]
        picture = np.concatenate(rows)
        each = picture.shape[1] // len(labels[here])
        head = np.concatenate([label_bar("", _SIDE), *(label_bar(label, each) for label in labels[here])], axis=1)
        body = np.concatenate([_side_labels(list(lines), picture.shape[0]), picture], axis=1)
        blocks.append(np.concatenate([head, body]))
    width = max(block.shape[1] for block in blocks)
    padded = [np.pad(b, ((0, 0), (0, width - b.shape[1]), (0, 0)), constant_values=24) for b in blocks]
    write_png(path, np.concatenate([label_bar(title, width), *padded]))


_COLUMNS = 4
_SIDE = 84


def _side_labels(names: Sequence[str], height: int) -> NDArray[np.uint8]:
    each = height // len(names)
    bars = [label_bar(name, _SIDE, each) for name in names]
    return np.concatenate([*bars, np.full((height - each * len(names), _SIDE, 3), 24, np.uint8)])


def _column_labels(steps: Sequence[int], width: int) -> NDArray[np.uint8]:
    each = (width - _SIDE) // len(steps)
    bars = [label_bar("", _SIDE), *(label_bar(f"step {step}", each) for step in steps)]
    row = np.concatenate(bars, axis=1)
    return np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=24)


def write_particle_plot(
    path: Path,
    frames: Sequence[tuple[str, NDArray[np.floating], NDArray[np.uint8]]],
    workspace_min: Sequence[float],
    workspace_max: Sequence[float],
) -> None:
    """Plot coloured particles in 3-D, one panel per (title, positions (particle, 3), colours (particle, 3) uint8)."""
    columns = min(len(frames), 4)
    rows = -(-len(frames) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.4 * rows), layout="constrained")
    for number, (title, positions, colors) in enumerate(frames):
        axis: Any = figure.add_subplot(rows, columns, number + 1, projection="3d", computed_zorder=True)
        axis.scatter(*positions.T, c=colors / 255.0, s=5, linewidths=0, depthshade=False)
        axis.set_title(title, fontsize=9)
        for name, low, high in zip("xyz", workspace_min, workspace_max, strict=True):
            getattr(axis, f"set_{name}lim")(low, high)
            getattr(axis, f"set_{name}ticks")([low, (low + high) / 2, high])
        axis.set_box_aspect([high - low for low, high in zip(workspace_min, workspace_max, strict=True)])
        axis.view_init(elev=25, azim=-60)
        axis.tick_params(labelsize=6)
    _save(figure, path)


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an RGB image (height, width, 3)."""
    encoded = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1]
    with AtomicPath(path) as partial:
        partial.write_bytes(encoded.tobytes())


def _save(figure: Figure, path: Path) -> None:
    with AtomicPath(path) as partial, partial.open("wb") as stream:
        figure.savefig(stream, format="png", dpi=130)
