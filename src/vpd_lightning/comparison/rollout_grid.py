"""Strips: the same rollout as every system predicted it, one row per system, one column per step."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.comparison.comparison_table import ComparisonTable, Row
from vpd_lightning.comparison.kept_rollouts import KeptRollouts, Rollout, camera_title, clip_file_name, of_same_truth
from vpd_lightning.media.pictures import write_png
from vpd_lightning.media.video import enlarge, framed, label_bar

_MIN_PANEL = 96
_SIDE = 118
_MAX_STEPS = 8
_NUM_SHOWN = 2  # shown of the context; SlotFormer has six
_DARK = 24


def write_strips(folder: Path, table: ComparisonTable, kept: KeptRollouts) -> list[Path]:
    """Write ``strips_<table>_<clip>.png`` for every clip that some system's main row kept."""
    written = []
    for clip, views in kept.clips.items():
        path = folder / f"strips_{table.file_name}_{clip_file_name(clip)}.png"
        blocks = [_block(clip, view, rollouts, table.main_rows) for view, rollouts in sorted(views.items())]
        width = max(block.shape[1] for block in blocks)
        padded = [np.pad(b, ((0, 0), (0, width - b.shape[1]), (0, 0)), constant_values=_DARK) for b in blocks]
        write_png(path, np.concatenate(padded))
        written.append(path)
    return written


def strip_steps(num_steps: int) -> list[int]:
    """The steps that are shown (from 1): the first, the last, and some evenly between them."""
    count = min(num_steps, _MAX_STEPS)
    return [int(step) for step in np.unique(np.linspace(1, num_steps, count).round().astype(int))]


def _block(clip: str, view: int, rollouts: dict[str, Rollout], rows: Sequence[Row]) -> NDArray[np.uint8]:
    """All rows of one camera. The truth is that of the first system; a system with another truth is left out."""
    first = next(iter(rollouts.values()))
    context = first.context[-_NUM_SHOWN:]
    steps = strip_steps(len(first.truth))
    heads = [f"input {i - len(context) + 1}" for i in range(len(context))] + [f"step {step}" for step in steps]
    lines = [_line("truth", [*context, *(first.truth[step - 1] for step in steps)])]
    for system, rollout in of_same_truth(rollouts, rows).items():
        images = [rollout.fitted_prediction[step - 1] for step in steps]
        lines.append(_line(system, [*np.full_like(context, _DARK), *images]))
    each = (lines[0].shape[1] - _SIDE) // len(heads)
    bars = [label_bar("", _SIDE), *(label_bar(head, each) for head in heads)]
    block = np.concatenate([np.concatenate(bars, axis=1), *lines])
    return np.concatenate([label_bar(camera_title(clip, view, rollouts, rows), block.shape[1]), block])


def _line(name: str, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    picture = np.concatenate([framed(enlarge(image, _MIN_PANEL)) for image in images], axis=1)
    return np.concatenate([label_bar(name, _SIDE, picture.shape[0]), picture], axis=1)
