"""The rollouts that evaluations kept, brought together by clip, camera and system."""

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from vpd_lightning.comparison.comparison_table import ComparisonTable, Row

_MAX_BYTES = 2**31


@dataclass(frozen=True)
class Rollout:
    """One clip from one camera: what was seen, what happened, and what was predicted."""

    context: UInt8[np.ndarray, "time height width 3"]
    truth: UInt8[np.ndarray, "step height width 3"]
    prediction: UInt8[np.ndarray, "step other_height other_width 3"]

    @property
    def fitted_prediction(self) -> NDArray[np.uint8]:
        """The prediction at the resolution of the truth, without smoothing."""
        height, width = self.truth.shape[1:3]
        if self.prediction.shape[1:3] == (height, width):
            return self.prediction
        size = (width, height)
        return np.stack([cv2.resize(image, size, interpolation=cv2.INTER_NEAREST) for image in self.prediction])


@dataclass(frozen=True)
class KeptRollouts:
    """``clips[name][camera][system]``, and the files that could not be read, with the reason."""

    clips: dict[str, dict[int, dict[str, Rollout]]]
    skipped: list[tuple[Path, str]]


def kept_rollouts(table: ComparisonTable) -> KeptRollouts:
    """Read what the main row of every system kept; of several seeds, the first."""
    clips: dict[str, dict[int, dict[str, Rollout]]] = {}
    skipped: list[tuple[Path, str]] = []
    for row in table.main_rows:
        path = row.runs[0].evaluation / "rollouts.npz"
        if not path.exists():
            skipped.append((path, "not there: an older version evaluated the run"))
            continue
        try:
            for clip, view, rollout in _rollouts(path):
                clips.setdefault(clip, {}).setdefault(view, {})[row.system] = rollout
        except (OSError, ValueError, KeyError, IndexError, zipfile.BadZipFile, EOFError) as error:
            skipped.append((path, f"cannot be read: {type(error).__name__}"))
    return KeptRollouts(clips, skipped)


def of_same_truth(rollouts: dict[str, Rollout], rows: Sequence[Row]) -> dict[str, Rollout]:
    """Return, in the order of the rows, the systems that predicted what the first one predicted."""
    first = next(iter(rollouts.values()))
    named = ((row.system, rollouts.get(row.system)) for row in rows)
    return {system: one for system, one in named if one is not None and np.array_equal(one.truth, first.truth)}


def clip_file_name(clip: str) -> str:
    """A clip's name as files are named: ``test/000000.h5@4`` is ``test_000000_start4``."""
    return clip.replace("/", "_").replace(".h5@", "_start")


def camera_title(clip: str, view: int, rollouts: dict[str, Rollout], rows: Sequence[Row]) -> str:
    """Say which clip and camera it is, and whether the systems were given that camera's pictures."""
    seen = {
        view in (row.runs[0].metrics["protocol"].get("input_views") or ()) for row in rows if row.system in rollouts
    }
    kind = "input view" if seen == {True} else "never an input" if seen == {False} else "an input of some systems"
    return f"{clip}, camera {view} ({kind})"


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
