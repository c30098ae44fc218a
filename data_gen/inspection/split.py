"""Dividing a data set anew into training, validation and test: only ``dataset.json`` changes."""

import math
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vpd_lightning.data.hdf5.checks import checked_attribute, open_file
from vpd_lightning.data.manifest import FILE_NAME, SPLITS, Manifest, load_manifest, write_manifest
from vpd_lightning.errors import ConfigError, DataError
from vpd_lightning.files import AtomicPath

BACKUP_NAME = f"{FILE_NAME}.bak"
RECORDING = "recording"  # attribute of files that were cut from one recording
_NOTE = "; split by "
_EXAMPLE = "For example: train=0.8 validation=0.1 test=0.1, or validation=16 test=16 (train takes the rest)."


@dataclass(frozen=True)
class SplitResult:
    """How many trajectories, and how many recordings they were cut from, each split has now."""

    num_trajectories: dict[str, int]
    num_recordings: dict[str, int]


def split_dataset(
    folder: str | Path,
    *,
    train: Any = None,
    validation: Any = None,
    test: Any = None,
    seed: Any = 0,
) -> SplitResult:
    """Divide the trajectories of a data set by chance, and rewrite its manifest in one step.

    Whole numbers (int) count recordings, fractions (float) are shares of them; one of the three may be left out and
    takes the rest. A trajectory is a recording of its own unless its attribute ``recording`` names one: clips of one
    recording always stay together, because they show the same things. The same seed and numbers give the same division,
    however the data set was divided before. The first manifest is kept as ``dataset.json.bak``.

    Raises:
        ConfigError: numbers that cannot be met.
        DataError: the data set is missing or damaged.
    """
    wanted = {"train": train, "validation": validation, "test": test}
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
        raise ConfigError(f"seed is {seed!r}; allowed: whole numbers from 0 to 2^63 - 1.")
    manifest = load_manifest(folder)
    recordings = _recordings(manifest)
    counts = recording_counts(wanted, len(recordings))
    names = sorted(recordings)
    order = [names[i] for i in np.random.default_rng([seed, 11]).permutation(len(names))]
    parts: dict[str, list[str]] = {}
    for split in SPLITS:
        parts[split], order = order[: counts[split]], order[counts[split] :]
    splits = {split: sorted(path for name in parts[split] for path in recordings[name]) for split in SPLITS}
    _write(manifest, splits, _command(wanted, seed))
    return SplitResult(
        {split: len(files) for split, files in splits.items()}, {split: len(names) for split, names in parts.items()}
    )


def recording_counts(wanted: Mapping[str, Any], total: int) -> dict[str, int]:
    """Return how many of ``total`` recordings each split gets.

    Raises:
        ConfigError: negative numbers, numbers and fractions mixed, or sums that do not come out.
    """
    given = {name: value for name, value in wanted.items() if value is not None}
    listed = " ".join(f"{name}={value}" for name, value in given.items())
    if not given:
        raise ConfigError(f"split needs numbers or fractions.\n{_EXAMPLE}")
    for name, value in given.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < math.inf:
            raise ConfigError(f"{name} is {value!r}; a number of recordings or a fraction is needed.\n{_EXAMPLE}")
    left_out = [name for name in wanted if name not in given]
    if all(isinstance(value, int) for value in given.values()):
        counts = {name: int(value) for name, value in given.items()}
        rest = total - sum(counts.values())
        if rest < 0:
            raise ConfigError(f"{listed} needs {total - rest} recordings; there are {total}.")
        if rest and not left_out:
            raise ConfigError(f"{listed} is {total - rest} of {total} recordings.\nLeave one out: it takes the rest.")
        return dict.fromkeys(wanted, 0) | counts | ({left_out[0]: rest} if left_out else {})
    if any(value > 1 or (isinstance(value, int) and value) for value in given.values()):
        raise ConfigError(f"{listed} mixes numbers and fractions.\n{_EXAMPLE}")
    shares = dict.fromkeys(wanted, 0.0) | {name: float(value) for name, value in given.items()}
    missing = 1.0 - sum(shares.values())
    if missing < -1e-6 or (missing > 1e-6 and not left_out):
        raise ConfigError(f"{listed} adds up to {1 - missing:g}; fractions must add up to 1.\n{_EXAMPLE}")
    if left_out and missing > 1e-6:
        shares[left_out[0]] = missing
    parts = sum(value > 0 for value in shares.values())
    if parts > total:
        raise ConfigError(f"{listed} asks for {parts} splits of {total} recordings; each needs at least one.")
    return share(total, shares)


def share(total: int, fractions: Mapping[str, float]) -> dict[str, int]:
    """Divide a number by fractions: largest remainders, and at least 1 for each that is not 0.

    Where there are too few, the first ones get 1 each.
    """
    wanted = [name for name, fraction in fractions.items() if fraction > 0]
    counts = dict.fromkeys(fractions, 0)
    if total <= len(wanted):
        return counts | dict.fromkeys(wanted[:total], 1)
    whole = sum(fractions.values())
    exact = {name: total * fractions[name] / whole for name in wanted}
    counts.update({name: max(1, math.floor(value + 1e-9)) for name, value in exact.items()})
    while sum(counts.values()) < total:
        counts[max(wanted, key=lambda name: exact[name] - counts[name])] += 1
    while sum(counts.values()) > total:
        counts[max((name for name in wanted if counts[name] > 1), key=lambda name: counts[name] - exact[name])] -= 1
    return counts


def _recordings(manifest: Manifest) -> dict[str, list[Path]]:
    """Return the files of each recording; one that names none is a recording by itself, together with its copies."""
    found: dict[str, list[Path]] = {}
    first: dict[str, str] = {}  # of the files with the same bytes, the name that sorts first
    for name, checksum in sorted(manifest.sha256.items()):
        first.setdefault(checksum, name)
    for path in (path for files in manifest.splits.values() for path in files):
        with open_file(path) as file:
            named = RECORDING in file.attrs
            checksum = manifest.sha256[manifest.relative(path)]
            name = checked_attribute(path, file, RECORDING, "text") if named else first[checksum]
        found.setdefault(f"{int(named)} {name}", []).append(path)
    if not found:
        raise DataError(f"{manifest.folder} holds no trajectory to divide.")
    return found


def _write(manifest: Manifest, splits: dict[str, list[Path]], command: str) -> None:
    path, backup = manifest.folder / FILE_NAME, manifest.folder / BACKUP_NAME
    if not backup.exists():
        with AtomicPath(backup) as partial:
            shutil.copyfile(path, partial)
    generator = manifest.generator.partition(_NOTE)[0]
    write_manifest(replace(manifest, splits=splits, generator=f"{generator}{_NOTE}{command}"))


def _command(wanted: Mapping[str, Any], seed: int) -> str:
    numbers = " ".join(f"{name}={value}" for name, value in wanted.items() if value is not None)
    return f"vpd-data split {numbers} seed={seed}"
