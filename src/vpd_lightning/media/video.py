"""Films of predictions: VP9 in WebM or MP4 by OpenCV, looping WebP or GIF by Pillow; browsers play all four."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vpd_lightning.errors import ConfigError

_CODECS = {".webm": "VP90", ".mp4": "vp09"}
_ANIMATED: dict[str, dict[str, Any]] = {".webp": {"quality": 85, "method": 6}, ".gif": {"optimize": True}}
FILM_FORMATS = tuple(suffix[1:] for suffix in (*_CODECS, *_ANIMATED))
_MIN_PANEL = 256
_ERROR_RANGE = 0.5
_LABEL_HEIGHT = 22
_DARK = 24


def write_video(path: Path, frames: NDArray[np.uint8], frames_per_second: float) -> None:
    """Write RGB frames (time, height, width, 3); ``path`` exists only when the film is complete.

    The suffix decides: .webm and .mp4 are VP9, whose odd sizes lose their last row or column (it stores colour at half
    resolution); .webp and .gif are pictures that loop, for pages and slides that take no video.

    Raises:
        ConfigError: another suffix, or this OpenCV cannot write VP9.
        ValueError: there is no frame, or frames are not (height, width, 3).
    """
    if frames.ndim != 4 or frames.shape[-1] != 3 or min(frames.shape[:3]) < 1 or frames.dtype != np.uint8:
        raise ValueError(f"frames must be uint8 (time, height, width, 3), got {frames.dtype} {frames.shape}")
    suffix = path.suffix.lower()
    if suffix[1:] not in FILM_FORMATS:
        allowed = ", ".join(f".{name}" for name in FILM_FORMATS)
        raise ConfigError(f"Cannot write a film named {path.name}.\nAllowed suffixes: {allowed}.")
    height, width = frames.shape[1] // 2 * 2, frames.shape[2] // 2 * 2
    partial = path.with_name(f".{path.stem}.partial{suffix}")
    try:
        if suffix in _ANIMATED:
            first, *others = [Image.fromarray(frame) for frame in frames]
            duration = round(1000 / frames_per_second)  # milliseconds
            options = {"duration": duration, "loop": 0, **_ANIMATED[suffix]}
            first.save(partial, save_all=True, append_images=others, **options)
            os.replace(partial, path)
            return
        with _without_native_stderr():
            writer = cv2.VideoWriter(
                str(partial), cv2.VideoWriter.fourcc(*_CODECS[suffix]), frames_per_second, (width, height)
            )
        if not writer.isOpened():
            raise ConfigError(
                f"This OpenCV ({cv2.__version__}) cannot write VP9, so {path.name} was not made.\n"
                "Install opencv-python-headless from its wheel, which contains FFmpeg."
            )
        for frame in frames:
            writer.write(np.ascontiguousarray(frame[:height, :width, ::-1]))
        writer.release()
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def _without_native_stderr() -> Iterator[None]:
    """Keep FFmpeg's complaint about the (right) codec tag of WebM off the screen; it comes from C, past sys.stderr."""
    sys.stderr.flush()
    saved = os.dup(2)
    silence = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(silence, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(silence)
        os.close(saved)


def error_image(pred: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Mean absolute colour difference as a heat map: black is none, pale yellow is 0.5 (of 1) or more."""
    difference = np.abs(pred.astype(np.float32) - truth.astype(np.float32)).mean(-1) / 255.0
    level = np.clip(difference / _ERROR_RANGE, 0.0, 1.0)
    flat = (level * 255).astype(np.uint8).reshape(level.shape[0], -1) if level.ndim > 1 else level
    colored = cv2.applyColorMap(flat, cv2.COLORMAP_INFERNO)[..., ::-1]
    return np.ascontiguousarray(colored.reshape(*level.shape, 3))


def comparison_frames(
    truth: NDArray[np.uint8], pred: NDArray[np.uint8], views: Sequence[int], labels: Sequence[str]
) -> NDArray[np.uint8]:
    """Lay out truth | prediction | error for each step (time): one row per view, one label per frame.

    ``truth`` and ``pred`` are (time, view, height, width, 3); small images are enlarged without smoothing.
    """
    frames = []
    for time, label in enumerate(labels):
        rows = [panel_row(truth[time, view], pred[time, view]) for view in views]
        body = np.concatenate(rows, axis=0)
        third = body.shape[1] // 3
        titles = (f"truth  {label}", "prediction", "error")
        header = np.concatenate([label_bar(title, third) for title in titles], axis=1)
        frames.append(np.concatenate([header, body], axis=0))
    return np.stack(frames)


def panel_row(truth: NDArray[np.uint8], pred: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Truth, prediction and their difference side by side."""
    return np.concatenate([framed(enlarge(image)) for image in (truth, pred, error_image(pred, truth))], axis=1)


def framed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Put a dark line of one pixel around an image."""
    return np.pad(image, ((1, 1), (1, 1), (0, 0)), constant_values=_DARK)


def enlarge(image: NDArray[np.uint8], min_size: int = _MIN_PANEL) -> NDArray[np.uint8]:
    """Enlarge a small image by a whole factor to at least ``min_size`` pixels, without smoothing."""
    factor = max(1, -(-min_size // max(image.shape[:2])))
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def label_bar(text: str, width: int, height: int = _LABEL_HEIGHT) -> NDArray[np.uint8]:
    """Return white text on a dark bar (height, width, 3)."""
    bar = np.full((height, width, 3), _DARK, np.uint8)
    cv2.putText(bar, text, (6, height // 2 + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (235, 235, 235), 1, cv2.LINE_AA)
    return bar
