"""Which camera took which image when, where a source lists images one by one: from keys, or from file names."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_gen.importers.settings import ImportSettings
from vpd_lightning.errors import DataError

_CAMERA = re.compile(r"(?<![a-z])(?:camera|cam|view|c|v)[_-]?(\d+)", re.IGNORECASE)
_EVENNESS = 0.25  # a step may differ from the usual one by this share


@dataclass(frozen=True)
class Shot:
    """One listed image: its file's name, and what the source says of camera and time (``None``: nothing)."""

    name: str
    camera: str | None
    time: float | None


@dataclass(frozen=True)
class ShotOrder:
    """``index[time][view]``: which shot is which; the views' names; seconds from one frame to the next."""

    index: list[list[int]]
    views: list[str]
    frame_time: float


def order_shots(shots: Sequence[Shot], frame_time: float | None, settings: ImportSettings, where: str) -> ShotOrder:
    """Arrange images by time and camera.

    ``frame_time`` is what the source says, seconds; ``None`` where it does not.

    Raises:
        DataError: time or camera cannot be determined, cameras lack images, or frames are not evenly spaced.
    """
    cameras = _cameras(shots, where)
    views = sorted(set(cameras), key=_natural)
    times, are_seconds = _times(shots, len(views) > 1, settings, where)
    by_view = [sorted((i for i, c in enumerate(cameras) if c == view), key=lambda i: times[i]) for view in views]
    counts = {view: len(members) for view, members in zip(views, by_view, strict=True)}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{view} {count}" for view, count in list(counts.items())[:6])
        raise DataError(
            f"{where}: the cameras have different numbers of images: {listed}.\nEach frame needs all of them."
        )
    if len(by_view[0]) < 2:
        raise DataError(
            f"{where}: a static scene, all {len(shots)} images belong to one moment.\n"
            'Motion is learned from at least 3 frames; if the images follow each other in time, each needs its "time".'
        )
    table = np.array([[times[i] for i in members] for members in by_view])
    step = float(np.median(np.diff(table, axis=1)))
    _check_steps(shots, by_view, table, step, where)
    apart = np.abs(table - table[0]).max(axis=0)
    allowed = min(settings.max_time_difference, step / 2) if are_seconds else 0.0
    if apart.max() > allowed + 1e-9:
        frame = int(apart.argmax())
        raise DataError(
            f"{where}: the cameras' images of frame {frame} were taken {apart.max():g} apart"
            f"{f' (allowed: {allowed:g} s; max_time_difference)' if are_seconds else ' (in their numbers)'}.\n"
            f"First: {shots[by_view[0][frame]].name}."
        )
    seconds = settings.frame_time or frame_time or (step if are_seconds else None)
    if seconds is None:
        raise DataError(
            f"{where} does not say how much time lies between two frames.\nGive it in seconds: frame_time=0.05"
        )
    if are_seconds and settings.frame_time is None and frame_time is None and _looks_normalised(table):
        raise DataError(
            f"{where}: times run from 0 to 1, which are hardly seconds.\n"
            f"Give the time from one frame to the next: frame_time=SECONDS (there are {table.shape[1]} frames)."
        )
    return ShotOrder([list(row) for row in zip(*by_view, strict=True)], views, seconds)


def _cameras(shots: Sequence[Shot], where: str) -> list[str]:
    named = [shot.camera for shot in shots if shot.camera is not None]
    if named and len(named) < len(shots):
        index = next(i for i, shot in enumerate(shots) if shot.camera is None)
        raise DataError(f"{where}: frame {index} ({shots[index].name}) names no camera, others do.")
    if named:
        return named
    found = [_CAMERA.search(_path_without_suffix(shot.name)) for shot in shots]
    if all(found):
        return [match.group(0) if match else "" for match in found]
    return [shot.name.rpartition("/")[0] for shot in shots]


def _times(
    shots: Sequence[Shot], are_many_cameras: bool, settings: ImportSettings, where: str
) -> tuple[list[float], bool]:
    """Return the time of each image, and whether that is in the source's seconds (or a number from its name)."""
    given = [shot.time for shot in shots if shot.time is not None]
    if given and len(given) < len(shots):
        index = next(i for i, shot in enumerate(shots) if shot.time is None)
        raise DataError(f'{where}: frame {index} ({shots[index].name}) has no "time", others do.')
    if given:
        return given, True
    if not are_many_cameras and not settings.moving_camera:
        raise DataError(
            f"{where} does not say when its {len(shots)} images were taken; a static scene is one frame, too few to "
            'learn motion from.\nGive each frame "time" (seconds) and, for several cameras, "camera".\n'
            "If they are consecutive frames of one moving camera: moving_camera=true frame_time=SECONDS"
        )
    numbers = []
    for shot in shots:
        found = re.findall(r"\d+", _CAMERA.sub("|", _path_without_suffix(shot.name), count=1))
        if not found or len(found[-1]) > 15:
            raise DataError(
                f'{where}: the name {shot.name} holds no number of a frame.\nGive each frame "time" (seconds).'
            )
        numbers.append(float(found[-1]))
    return numbers, False


def _check_steps(shots: Sequence[Shot], by_view: list[list[int]], table: np.ndarray, step: float, where: str) -> None:
    steps = np.diff(table, axis=1)
    if steps.min() <= 0:
        view, frame = np.argwhere(steps <= 0)[0]
        first, second = (shots[by_view[view][frame + i]].name for i in (0, 1))
        raise DataError(f'{where}: {first} and {second} have one camera and one time.\nGive each frame its "camera".')
    uneven = np.abs(steps - step) > _EVENNESS * step
    if uneven.any():
        view, frame = np.argwhere(uneven)[0]
        name = shots[by_view[view][frame]].name
        raise DataError(
            f"{where}: frames are not evenly spaced: after {name} comes a step of {steps[view, frame]:g}, usual is "
            f"{step:g}.\nCut the recording there, or leave out the odd frames."
        )


def _looks_normalised(table: np.ndarray) -> bool:
    return bool(table.min() == 0.0 and table.max() == 1.0)


def _path_without_suffix(name: str) -> str:
    folder, slash, file = name.rpartition("/")
    return folder + slash + (file.rpartition(".")[0] or file)


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key that puts cam2 before cam10."""
    return [(int(part[:15]), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
