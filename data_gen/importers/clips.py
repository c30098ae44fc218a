"""Which trajectories an import makes: recordings cut into clips, and whole recordings given to splits."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_gen.importers.recording import MIN_FRAMES, Recording
from data_gen.importers.settings import ImportSettings
from data_gen.inspection.split import share
from vpd_lightning.data.manifest import SPLITS
from vpd_lightning.errors import DataError

_MAX_REMARKS = 4  # about single recordings


@dataclass(frozen=True)
class Clip:
    """One trajectory to write: some frames of one recording."""

    recording: Recording
    number: int  # among the clips of its recording
    frames: range
    split: str
    path: Path  # relative to the data set


def plan_clips(recordings: Sequence[Recording], settings: ImportSettings) -> tuple[list[Clip], list[str]]:
    """Return all trajectories in order, and remarks for the user.

    Clips of one recording stay in one split, because neighbouring stretches of one recording show the same things.

    Raises:
        DataError: nothing is long enough.
    """
    remarks: list[str] = []
    windows = {recording.name: _windows(recording, settings, remarks) for recording in recordings}
    if len(remarks) > _MAX_REMARKS:
        remarks[_MAX_REMARKS:] = [f"... and {len(remarks) - _MAX_REMARKS} more recordings like these."]
    kept = [recording for recording in recordings if windows[recording.name]]
    if not kept:
        longest = max(len(range(0, recording.num_frames, settings.every)) for recording in recordings)
        wanted = f"clip_frames={settings.clip_frames}" if settings.clip_frames else f"at least {MIN_FRAMES} frames"
        raise DataError(
            f"No recording is long enough for {wanted}; the longest has {longest} frames"
            f"{f' with every={settings.every}' if settings.every > 1 else ''}.\n"
            "A static scene (one frame) cannot teach motion; record a video, or lower every or clip_frames."
        )
    splits = divide_recordings({recording.name: recording.split for recording in kept}, settings, remarks)
    counts = dict.fromkeys(SPLITS, 0)
    clips = []
    for recording in kept:
        split = splits[recording.name]
        for number, frames in enumerate(windows[recording.name]):
            clips.append(Clip(recording, number, frames, split, Path(split) / f"{counts[split]:06d}.h5"))
            counts[split] += 1
    return clips, remarks


def divide_recordings(given: Mapping[str, str | None], settings: ImportSettings, remarks: list[str]) -> dict[str, str]:
    """Give each recording a split: the source's where it names one, the others by fraction, drawn by the seed."""
    fractions = {name: float(getattr(settings.splits, name)) for name in SPLITS}
    open_names = sorted(name for name, split in given.items() if split is None)
    result = {name: split for name, split in given.items() if split is not None}
    counts = share(len(open_names), fractions)
    order = [open_names[i] for i in np.random.default_rng([settings.seed, 7]).permutation(len(open_names))]
    for split in SPLITS:
        result.update(dict.fromkeys(order[: counts[split]], split))
        order = order[counts[split] :]
    empty = [split for split in SPLITS if fractions[split] > 0 and split not in result.values()]
    if empty:
        noun = "recording" if len(given) == 1 else "recordings"
        remarks.append(
            f"{len(given)} {noun}: nothing is left for {' and '.join(empty)} (clips of one recording never go to two "
            f"splits).\n  Import more recordings together (a folder of them): {len(fractions)} are enough for all. "
            "Until then train with data.num_validation_clips=0 where validation is missing."
        )
    return result


def _windows(recording: Recording, settings: ImportSettings, remarks: list[str]) -> list[range]:
    frames = range(0, recording.num_frames, settings.every)
    length = settings.clip_frames or len(frames)
    if len(frames) < max(length, MIN_FRAMES):
        remarks.append(f"{recording.name} has {len(frames)} frames, too few: left out.")
        return []
    count = len(frames) // length
    left = len(frames) - count * length
    if left:
        remarks.append(f"{recording.name}: the last {left} of {len(frames)} frames fill no clip: left out.")
    return [frames[i * length : (i + 1) * length] for i in range(count)]
