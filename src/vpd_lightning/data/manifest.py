"""``dataset.json``: which trajectories a data set holds, in which split, and the SHA-256 of each file."""

import difflib
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from vpd_lightning.data.schema import SCHEMA_VERSION
from vpd_lightning.errors import DataError
from vpd_lightning.files import AtomicPath

FILE_NAME = "dataset.json"
UNFINISHED_NAME = ".unfinished.json"  # what a data set in the making was asked to be
SPLITS = ("train", "validation", "test")
_MAX_BYTES = 64 * 2**20
_MAX_TRAJECTORIES = 400_000
_MAX_BRACKETS = _MAX_TRAJECTORIES + 10_000


@dataclass(frozen=True)
class Manifest:
    """A data set on disk. ``splits`` holds absolute paths; ``sha256`` and ``num_bytes`` go by the relative name."""

    folder: Path
    name: str
    scene: str
    preset: str
    seed: int
    splits: dict[str, list[Path]]
    sha256: dict[str, str]
    num_bytes: dict[str, int]
    settings: dict[str, Any] = field(default_factory=dict)
    generator: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    license: str = ""

    def relative(self, path: Path) -> str:
        """Return a trajectory's name as the manifest writes it, for example ``train/000000.h5``."""
        return path.relative_to(self.folder).as_posix()

    def split(self, name: str) -> list[Path]:
        """Return the files of one split, or raise ``DataError`` naming the splits there are."""
        if not self.splits.get(name):
            present = ", ".join(f"{key} ({len(files)})" for key, files in self.splits.items() if files) or "none"
            raise DataError(f"{self.folder} has no split {name!r}.\nSplits with trajectories: {present}.")
        return self.splits[name]

    def checksums(self, paths: Iterable[Path]) -> list[str]:
        """Return the SHA-256 of some of its files: what identifies a trajectory, whatever its name or folder."""
        return [self.sha256[self.relative(path)] for path in paths]

    @property
    def digest(self) -> str:
        """SHA-256 over names, checksums and splits: with one digest, two data sets are the same and divided alike.

        A split is named where it is not the one that the file's folder says, so that sets which were never divided
        anew keep the digest that earlier versions gave them.
        """
        splits = {self.relative(path): split for split, files in self.splits.items() for path in files}
        moved = {name: "" if name.partition("/")[0] == split else f" {split}" for name, split in splits.items()}
        lines = "".join(f"{name} {value}{moved[name]}\n" for name, value in sorted(self.sha256.items()))
        return hashlib.sha256(lines.encode()).hexdigest()

    @property
    def files_digest(self) -> str:
        """SHA-256 over names and checksums alone: it stays as it is where the same files are divided anew."""
        lines = "".join(f"{name} {value}\n" for name, value in sorted(self.sha256.items()))
        return hashlib.sha256(lines.encode()).hexdigest()

    def repeated(self) -> list[tuple[Path, Path]]:
        """Return pairs of files of different splits that hold the same bytes: one trajectory under two names."""
        first: dict[str, tuple[str, Path]] = {}
        pairs = []
        for split, files in self.splits.items():
            for path, checksum in zip(files, self.checksums(files), strict=True):
                other, twin = first.setdefault(checksum, (split, path))
                if other != split:
                    pairs.append((twin, path))
        return pairs


def write_manifest(manifest: Manifest) -> Path:
    """Write ``dataset.json`` atomically, after all trajectories, and return its path."""
    content = {
        "schema_version": SCHEMA_VERSION,
        "name": manifest.name,
        "scene": manifest.scene,
        "preset": manifest.preset,
        "seed": manifest.seed,
        "license": manifest.license,
        "generator": manifest.generator,
        "versions": manifest.versions,
        "settings": manifest.settings,
        "splits": {
            split: [
                {
                    "file": manifest.relative(path),
                    "sha256": manifest.sha256[manifest.relative(path)],
                    "bytes": manifest.num_bytes[manifest.relative(path)],
                }
                for path in files
            ]
            for split, files in manifest.splits.items()
        },
    }
    path = manifest.folder / FILE_NAME
    with AtomicPath(path) as partial:
        partial.write_text(json.dumps(content, indent=1) + "\n")
    return path


def load_manifest(folder: str | Path) -> Manifest:
    """Read ``dataset.json`` and check that every file it names is there with its size.

    Raises:
        DataError: the data set is missing (the message holds the command that makes it), incomplete or damaged.
    """
    folder = Path(folder).expanduser().absolute()
    path = folder / FILE_NAME
    if not path.is_file():
        raise DataError(_missing(folder))
    if path.stat().st_size > _MAX_BYTES:
        raise DataError(f"{path} has {path.stat().st_size} bytes, more than the allowed {_MAX_BYTES}.")
    try:
        text = path.read_text()
        if text.count("[") + text.count("{") > _MAX_BRACKETS:  # each would become an object of 56 bytes or more
            raise ValueError(f"more than {_MAX_BRACKETS} lists and objects")
        content = json.loads(text)
    except (ValueError, OSError, RecursionError) as error:
        raise DataError(f"{path} cannot be read: {error}.\nRestore it, or generate the data set again.") from error
    version = content.get("schema_version") if isinstance(content, dict) else None
    if version != SCHEMA_VERSION:
        raise DataError(f"{path} has schema version {version!r}; this program reads version {SCHEMA_VERSION}.")
    try:
        return _parse(folder, content)
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise DataError(f"{path} is not a manifest: {type(error).__name__} {error}.") from error


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file as hexadecimal digits."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _parse(folder: Path, content: Mapping[str, Any]) -> Manifest:
    splits: dict[str, list[Path]] = {}
    sha256: dict[str, str] = {}
    num_bytes: dict[str, int] = {}
    for split, entries in content["splits"].items():
        splits[split] = []
        for entry in entries:
            name = str(entry["file"])
            path = _inside(folder, name)
            splits[split].append(path)
            sha256[name], num_bytes[name] = str(entry["sha256"]), int(entry["bytes"])
    if len(sha256) != sum(map(len, splits.values())):
        raise DataError(f"{folder / FILE_NAME} names a trajectory twice; splits must not share files.")
    if len(sha256) > _MAX_TRAJECTORIES:
        raise DataError(f"{folder / FILE_NAME} names {len(sha256)} files, more than the allowed {_MAX_TRAJECTORIES}.")
    _check_files(folder, num_bytes)
    _check_places(folder, sha256)
    return Manifest(
        folder=folder,
        name=str(content["name"]),
        scene=str(content["scene"]),
        preset=str(content.get("preset", "")),
        seed=int(content.get("seed", 0)),
        splits=splits,
        sha256=sha256,
        num_bytes=num_bytes,
        settings=dict(content.get("settings", {})),
        generator=str(content.get("generator", "")),
        versions={str(key): str(value) for key, value in content.get("versions", {}).items()},
        license=str(content.get("license", "")),
    )


def _inside(folder: Path, name: str) -> Path:
    """Refuse names that lead out of the data set: a manifest from elsewhere must not point at other files."""
    relative = PurePosixPath(name)
    is_plain = (
        relative.as_posix() == name and not relative.is_absolute() and not {"..", "\\"} & {*relative.parts, *name}
    )
    if not is_plain or relative.suffix != ".h5":
        raise DataError(f"{folder / FILE_NAME} names {name!r}; only .h5 files inside the data set are allowed.")
    return folder / relative


def _check_files(folder: Path, num_bytes: Mapping[str, int]) -> None:
    faults = []
    for name, expected in num_bytes.items():
        path = folder / name
        if not path.is_file():
            faults.append(f"{name} is missing")
        elif path.stat().st_size != expected:
            faults.append(f"{name} has {path.stat().st_size} bytes instead of {expected}")
    if faults:
        raise DataError(
            f"{folder}: {len(faults)} of {len(num_bytes)} trajectories are missing or damaged.\n"
            f"First: {faults[0]}.\n"
            f"Copy the data set again, or delete its {FILE_NAME} and damaged files and generate them again (the others "
            "are kept)."
        )


def _check_places(folder: Path, names: Mapping[str, str]) -> None:
    """Refuse symbolic links that leave the data set, or that bring one trajectory into two splits."""
    home = folder.resolve()
    seen: set[Path] = set()
    for name in names:
        place = (folder / name).resolve()
        if not place.is_relative_to(home):
            raise DataError(
                f"{folder / name} is a symbolic link that leads out of the data set; copy the file instead."
            )
        if place in seen:
            raise DataError(f"{folder / FILE_NAME} names a trajectory twice (by a symbolic link); splits must differ.")
        seen.add(place)


def _missing(folder: Path) -> str:
    if (folder / UNFINISHED_NAME).is_file():
        return f"{folder} is not finished (there is no {FILE_NAME}).\nRepeat the command that started it: it resumes."
    scene, _, preset = folder.name.rpartition("_")
    if scene and preset in ("paper", "demo", "tiny"):
        command, hint = f"scene={scene} preset={preset}", ""
    else:  # the name does not say what should be in there
        command, hint = "scene=SCENE preset=PRESET", "  (vpd-data --help lists both)"
    return (
        f"No data set in {folder} (there is no {FILE_NAME}).{did_you_mean(folder)}\n"
        f"Make it:  vpd-data generate {command} out={folder}{hint}\n"
        "or point data.folder at one that exists. A recording must be imported first: vpd-data import SOURCE out=FOLDER"
    )


def did_you_mean(folder: Path) -> str:
    """Return a line that names the data sets nearby whose names are much like this one's, or nothing."""
    places = [folder.parent] if folder.parent.is_dir() else _subfolders(folder.parent.parent)
    known = {
        f"{place.name}/{path.parent.name}": path.parent for place in places for path in place.glob(f"*/{FILE_NAME}")
    }
    near = difflib.get_close_matches(f"{folder.parent.name}/{folder.name}", sorted(known), n=3, cutoff=0.7)
    return f"\nDid you mean {' or '.join(str(known[name]) for name in near)}?" if near else ""


def _subfolders(place: Path) -> list[Path]:
    try:
        return [path for path in place.iterdir() if path.is_dir()]
    except OSError:
        return []
