"""Strips: the same rollout as every system predicted it, one row per system, one column per step."""

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from vpd_lightning.export.pictures import write_png
from vpd_lightning.export.video import enlarge, framed, label_bar
from vpd_lightning.report.board import Board, Row

_MIN_PANEL = 96
_SIDE = 118
_MAX_STEPS = 8
_NUM_CONTEXT = 2  # shown of the context; SlotFormer has six
_DARK = 24
_MAX_BYTES = 2**31


@dataclass(frozen=True)
class Rollout:
    """One clip from one camera: what was seen, what happened, and what was predicted."""

    context: UInt8[np.ndarray, "time height width 3"]
    truth: UInt8[np.ndarray, "step height width 3"]
    prediction: UInt8[np.ndarray, "step other_height other_width 3"]


def write_strips(folder: Path, board: Board) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Write ``strips_<board>_<clip>.png`` for every clip that some system's main row kept.

    Returns the pictures and, for what could not be shown, the file and why.
    """
    kept: dict[str, dict[int, dict[str, Rollout]]] = {}
    skipped: list[tuple[Path, str]] = []
    for row in board.main_rows:
        path = row.runs[0].evaluation / "rollouts.npz"
        if not path.exists():
            skipped.append((path, "not there: an older version evaluated the run"))
            continue
        try:
            for clip, view, rollout in _rollouts(path):
                kept.setdefault(clip, {}).setdefault(view, {})[row.system] = rollout
        except (OSError, ValueError, KeyError, IndexError, zipfile.BadZipFile, EOFError) as error:
            skipped.append((path, f"cannot be read: {type(error).__name__}"))
    written = []
    for clip, views in kept.items():
        name = clip.replace("/", "_").replace(".h5@", "_start")
        path = folder / f"strips_{board.file_name}_{name}.png"
        blocks = [_block(clip, view, rollouts, board.main_rows) for view, rollouts in sorted(views.items())]
        width = max(block.shape[1] for block in blocks)
        padded = [np.pad(b, ((0, 0), (0, width - b.shape[1]), (0, 0)), constant_values=_DARK) for b in blocks]
        write_png(path, np.concatenate(padded))
        written.append(path)
    return written, skipped


def strip_steps(num_steps: int) -> list[int]:
    """The steps that are shown (from 1): the first, the last, and some evenly between them."""
    count = min(num_steps, _MAX_STEPS)
    return [int(step) for step in np.unique(np.linspace(1, num_steps, count).round().astype(int))]


def _rollouts(path: Path) -> Iterator[tuple[str, int, Rollout]]:
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError("too large")
    with np.load(path, allow_pickle=False) as arrays:
        clips, views = arrays["clips"], arrays["views"]
        context, truth, prediction = (np.asarray(arrays[name]) for name in ("context", "truth", "prediction"))
    for array in (context, truth, prediction):
        if array.dtype != np.uint8 or array.ndim != 6 or array.shape[-1] != 3:
            raise ValueError("images are not uint8 (clip, time, view, height, width, 3)")
    for i, clip in enumerate(clips):
        for j, view in enumerate(views):
            yield str(clip), int(view), Rollout(context[i, :, j], truth[i, :, j], prediction[i, :, j])


def _block(clip: str, view: int, rollouts: dict[str, Rollout], rows: Sequence[Row]) -> NDArray[np.uint8]:
    """All rows of one camera. The truth is that of the first system; a system with another truth is left out."""
    first = next(iter(rollouts.values()))
    context = first.context[-_NUM_CONTEXT:]
    steps = strip_steps(len(first.truth))
    heads = [f"input {i - len(context) + 1}" for i in range(len(context))] + [f"step {step}" for step in steps]
    lines = [_line("truth", [*context, *(first.truth[step - 1] for step in steps)])]
    height, width = first.truth.shape[1:3]
    for row in rows:
        rollout = rollouts.get(row.system)
        if rollout is None or not np.array_equal(rollout.truth, first.truth):
            continue
        images = [_fitted(rollout.prediction[step - 1], height, width) for step in steps]
        lines.append(_line(row.system, [*np.full_like(context, _DARK), *images]))
    each = lines[0].shape[1] - _SIDE
    each //= len(heads)
    bars = [label_bar("", _SIDE), *(label_bar(head, each) for head in heads)]
    block = np.concatenate([np.concatenate(bars, axis=1), *lines])
    seen = {
        view in (row.runs[0].metrics["protocol"].get("input_views") or ()) for row in rows if row.system in rollouts
    }
    kind = "input view" if seen == {True} else "never an input" if seen == {False} else "an input of some systems"
    return np.concatenate([label_bar(f"{clip}, camera {view} ({kind})", block.shape[1]), block])


def _line(name: str, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    picture = np.concatenate([framed(enlarge(image, _MIN_PANEL)) for image in images], axis=1)
    return np.concatenate([label_bar(name, _SIDE, picture.shape[0]), picture], axis=1)


def _fitted(image: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """Bring a system's own resolution to that of the truth, without smoothing."""
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
