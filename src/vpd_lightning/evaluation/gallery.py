"""The pictures of an evaluation: curves, a contact sheet, and films of the first clips."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.clip import Clip
from vpd_lightning.evaluation.evaluate import Evaluation
from vpd_lightning.evaluation.prediction import Prediction
from vpd_lightning.evaluation.report import step_table
from vpd_lightning.media.pictures import write_contact_sheet, write_curves
from vpd_lightning.media.video import comparison_frames, write_video

_MAX_COLUMNS = 6
_MAX_SHEET_CLIPS = 3
_SLOW_MOTION = 0.5
_MIN_SECONDS = 3.0


def write_gallery(folder: Path, metrics: Mapping[str, Any], evaluation: Evaluation, num_videos: int) -> None:
    """Write ``curves.png``, ``contact_sheet.png`` and ``videos/*.webm`` into ``folder``.

    Films run at half speed, or slower where they would end within three seconds.
    """
    write_curves(folder / "curves.png", step_table(metrics))
    views = evaluation.shown_views
    if evaluation.kept:
        _write_sheet(folder / "contact_sheet.png", evaluation, views)
    if num_videos > 0:
        (folder / "videos").mkdir()
    for clip, prediction in evaluation.kept[:num_videos]:
        truth, pred = with_last_input(clip, prediction)
        labels = [f"step {step}" for step in range(len(truth))]
        frames = comparison_frames(truth, pred, views, labels)
        write_video(
            folder / "videos" / f"{clip_file_name(clip)}.webm",
            frames,
            min(_SLOW_MOTION / clip.frame_time, len(frames) / _MIN_SECONDS),
        )


def with_last_input(clip: Clip, prediction: Prediction) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Truth and prediction as uint8 (time, view, height, width, 3); time 0 is the last input frame, reconstructed."""
    truth = np.concatenate([clip.rgb[-1:].numpy(), clip.target_rgb.numpy()])
    return truth, np.concatenate([prediction.reconstruction_uint8()[None], prediction.images_uint8()])


def clip_file_name(clip: Clip) -> str:
    """A file name for a clip, for example ``test_000003_start2``."""
    return clip.name.replace("/", "_").replace(".h5@", "_start")


def _write_sheet(path: Path, evaluation: Evaluation, views: list[int]) -> None:
    rows = []
    for clip, prediction in evaluation.kept[:_MAX_SHEET_CLIPS]:
        pred = prediction.images_uint8()
        for view in views:
            seen = "input view" if view in evaluation.input_views else "never an input"
            rows.append((f"{clip.name}, camera {view} ({seen})", clip.target_rgb[:, view].numpy(), pred[:, view]))
    num_steps = len(rows[0][1])
    steps = np.unique(np.linspace(1, num_steps, min(num_steps, _MAX_COLUMNS)).round().astype(int))
    write_contact_sheet(
        path, rows, steps.tolist(), "truth, prediction and error (black 0, pale yellow 0.5 or more of 1)"
    )
