"""Films: the same rollout as every system predicted it, side by side, one row per camera."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.comparison.comparison_table import ComparisonTable, Row
from vpd_lightning.comparison.kept_rollouts import KeptRollouts, Rollout, camera_title, clip_file_name, of_same_truth
from vpd_lightning.media.video import enlarge, framed, label_bar, write_video

_MIN_PANEL = 128
_DARK = 24
_STEPS_PER_SECOND = 8.0  # slower than the motion itself, so that one sees where systems part


def write_films(folder: Path, table: ComparisonTable, kept: KeptRollouts) -> list[Path]:
    """Write ``film_<table>_<clip>.webm`` for every clip that some system's main row kept.

    Raises:
        ConfigError: this OpenCV cannot write VP9.
    """
    written = []
    for clip, views in kept.clips.items():
        path = folder / f"film_{table.file_name}_{clip_file_name(clip)}.webm"
        rows = [_row(clip, view, rollouts, table.main_rows) for view, rollouts in sorted(views.items())]
        num_steps, width = (max(row.shape[axis] for row in rows) for axis in (0, 2))
        write_video(path, np.concatenate([_filled(row, num_steps, width) for row in rows], axis=1), _STEPS_PER_SECOND)
        written.append(path)
    return written


def _row(clip: str, view: int, rollouts: dict[str, Rollout], rows: Sequence[Row]) -> NDArray[np.uint8]:
    """One camera over the steps (step, height, width, 3): the truth, then every system that predicted it."""
    shown = of_same_truth(rollouts, rows)
    truth = next(iter(rollouts.values())).truth
    panels = {"truth": truth} | {system: rollout.fitted_prediction for system, rollout in shown.items()}
    frames = []
    for step in range(len(truth)):
        images = [framed(enlarge(images[step], _MIN_PANEL)) for images in panels.values()]
        names = [f"truth, step {step + 1}", *list(panels)[1:]]
        heads = [label_bar(name, image.shape[1]) for name, image in zip(names, images, strict=True)]
        body = np.concatenate([np.concatenate(heads, axis=1), np.concatenate(images, axis=1)])
        frames.append(np.concatenate([label_bar(camera_title(clip, view, rollouts, rows), body.shape[1]), body]))
    return np.stack(frames)


def _filled(row: NDArray[np.uint8], num_steps: int, width: int) -> NDArray[np.uint8]:
    """Bring a camera's row to a width, with dark at its right, and to a length, by its last frame."""
    row = np.pad(row, ((0, 0), (0, 0), (0, width - row.shape[2]), (0, 0)), constant_values=_DARK)
    return np.concatenate([row, row[-1:].repeat(num_steps - len(row), axis=0)])
