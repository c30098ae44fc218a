"""The folder of a data set in the making: never mixed with something else, resumable, never written twice at once.

Processes that make different shards of it may share it; whichever finds all files there finishes the set.
"""

import json
import os
import platform
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from data_gen.settings import differences, settings_hash
from data_gen.shards import WHOLE, Shard
from vpd_lightning.data.manifest import (
    FILE_NAME,
    SPLITS,
    UNFINISHED_NAME,
    Manifest,
    file_sha256,
    load_manifest,
    write_manifest,
)
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import DataError
from vpd_lightning.files import PARTIAL_SUFFIX, AtomicPath

_DISK_RESERVE = 64 * 2**20


class BusyFolderError(DataError):
    """Another process writes the folder, or has just finished it."""


class DatasetFolder:
    """Keeps what is to be made (``identity``) beside what is there already.

    Attributes:
        identity: everything that decides what the files hold, with ``scene`` and ``seed``; plain values for ``json``.
        scene_hash: changes with the identity; stands in each file.
    """

    def __init__(self, folder: Path, identity: Mapping[str, Any]) -> None:
        self.folder = folder
        self.identity: dict[str, Any] = json.loads(json.dumps(identity))
        self.scene_hash = settings_hash(self.identity)

    def is_complete(self) -> bool:
        """Tell whether the data set is finished; refuse one that was made from something else."""
        if not (self.folder / FILE_NAME).exists():
            return False
        manifest = load_manifest(self.folder)
        (self.folder / UNFINISHED_NAME).unlink(missing_ok=True)  # of a process killed after the manifest
        found = {"scene": manifest.scene, "seed": manifest.seed, **manifest.settings}
        self._refuse_other(found, "holds a finished data set")
        return True

    def done(self, paths: Sequence[Path]) -> set[Path]:
        """Return which files are there already, made from the same identity; refuse a folder with other files.

        Raises:
            DataError: the folder is a file, was begun with other settings, or holds strange trajectories.
        """
        if self.folder.exists() and not self.folder.is_dir():
            raise DataError(f"{self.folder} is a file. Choose another out=FOLDER.")
        present = sorted(self.folder.glob("*/*.h5"))
        plan = self.folder / UNFINISHED_NAME
        if present and plan.exists():
            try:
                found = json.loads(plan.read_text())
            except ValueError as error:
                raise DataError(f"{plan} is damaged. Delete {self.folder}, or choose another out=FOLDER.") from error
            self._refuse_other(found, "holds an unfinished data set")
        if not plan.exists() and (others := self._others()):
            raise DataError(
                f"{self.folder} holds other things, for example {others[0].name}.\n"
                "A data set gets a folder of its own: choose another out=FOLDER."
            )
        wanted = set(paths)
        strangers = [path for path in present if path not in wanted or not (plan.exists() or self._is_ours(path))]
        if strangers:
            raise DataError(
                f"{self.folder} holds files that are not from this run, for example "
                f"{strangers[0].relative_to(self.folder)}.\nChoose another out=FOLDER, or delete that folder."
            )
        return {path for path in paths if self._is_ours(path)}

    @contextmanager
    def claim(self, shard: Shard = WHOLE) -> Iterator[None]:
        """Make the folder, keep other processes out of it, and note what it is to become.

        Processes with different shards of it may hold it together.

        Raises:
            DataError: another process has it, or it cannot be written.
        """
        try:
            for split in SPLITS:
                (self.folder / split).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DataError(f"{self.folder} cannot be written: {error.strerror}. Choose another out=FOLDER.") from error
        handles = [os.open(self.folder, os.O_RDONLY)]
        try:
            if shard.is_whole:
                self._lock(handles[0], "LOCK_EX")
            else:
                self._lock(handles[0], "LOCK_SH")
                own = self.folder / f".shard-{shard.number}-of-{shard.count}.lock"
                handles.append(os.open(own, os.O_RDWR | os.O_CREAT, 0o644))
                self._lock(handles[1], "LOCK_EX")
            if (self.folder / FILE_NAME).exists():
                raise BusyFolderError(
                    f"Another vpd-data has just finished {self.folder}. Run the command again to see it."
                )
            if shard.is_whole:
                self._remove_left_overs()
            with AtomicPath(self.folder / UNFINISHED_NAME) as partial:
                partial.write_text(json.dumps(self.identity, indent=1) + "\n")
            yield
        finally:
            for handle in handles:
                os.close(handle)

    def _remove_left_overs(self) -> None:
        """Remove what killed processes left; only where no other process writes."""
        for folder in (self.folder, *(self.folder / split for split in SPLITS)):
            for left_over in [*folder.glob(f".*{PARTIAL_SUFFIX}"), *folder.glob(".shard-*.lock")]:
                left_over.unlink(missing_ok=True)

    def finish(
        self,
        splits: Mapping[str, Sequence[Path]],
        sha256: Mapping[Path, str],
        *,
        generator: str,
        packages: Sequence[str],
        preset: str = "",
        license: str = "",
    ) -> None:
        """Write the manifest, the last of all files, and remove the note; ``packages``: whose versions matter."""
        names = {path: path.relative_to(self.folder).as_posix() for path in sha256}
        write_manifest(
            Manifest(
                folder=self.folder,
                name=self.folder.name,
                scene=self.identity["scene"],
                preset=preset,
                seed=self.identity["seed"],
                splits={split: list(paths) for split, paths in splits.items()},
                sha256={names[path]: value for path, value in sha256.items()},
                num_bytes={names[path]: path.stat().st_size for path in sha256},
                settings={key: value for key, value in self.identity.items() if key not in ("scene", "seed")},
                generator=generator,
                versions=_versions(packages),
                license=license,
            )
        )
        (self.folder / UNFINISHED_NAME).unlink(missing_ok=True)

    def finish_shard(self, shard: Shard, paths: Sequence[Path], finish: Callable[[Mapping[Path, str]], None]) -> None:
        """After a shard is made: finish the set where all its files are there, else say what is still missing.

        Args:
            shard: what was made, no longer claimed.
            paths: all files of the set.
            finish: writes the manifest; gets the SHA-256 of all files.
        """
        missing = len(paths) - len(self.done(paths))
        if not missing:
            try:
                with self.claim():
                    finish({path: file_sha256(path) for path in paths})
            except BusyFolderError:
                print(f"shard {shard} of {self.folder} is made; another process finishes the set.")
            return
        print(
            f"shard {shard} of {self.folder} is made; {missing} files of the others are missing.\n"
            "The last one finishes the set. Without a common disk: copy all files (.unfinished.json, too) into one\n"
            "folder, and run the command once more without shard=."
        )

    def require_space(self, num_bytes: int, num_files: int, smaller: str) -> None:
        """Refuse to begin what would not fit on the disk; ``smaller`` says how to ask for less."""
        needed = num_bytes + _DISK_RESERVE
        existing = next(folder for folder in (self.folder, *self.folder.parents) if folder.exists())
        free = shutil.disk_usage(existing).free
        if free < needed:
            raise DataError(
                f"The disk of {self.folder} has {free / 2**30:.2f} GiB free; {num_files} trajectories need about "
                f"{needed / 2**30:.2f} GiB.\nFree some space, choose another out=FOLDER, or {smaller}."
            )

    def _others(self) -> list[Path]:
        """Return what lies in the folder and belongs to no data set (files that begin with a dot are let be)."""
        if not self.folder.is_dir():
            return []
        found = sorted(path for path in self.folder.iterdir() if not path.name.startswith("."))
        return [path for path in found if path.name not in SPLITS or not path.is_dir()]

    def _is_ours(self, path: Path) -> bool:
        """Tell whether a file is there, opens, and was made from this identity (its images are not read)."""
        if not path.exists():
            return False
        try:
            with TrajectoryReader(path) as reader:
                return reader.scene_hash == self.scene_hash
        except DataError:
            return False

    def _refuse_other(self, found: Mapping[str, Any], what: str) -> None:
        different = differences(self.identity, found)
        if different:
            raise DataError(
                f"{self.folder} {what} made from other settings; it is left as it is.\n"
                f"Asked for {'; '.join(different[:3])}{'; ...' if len(different) > 3 else ''}.\n"
                f"Choose another out=FOLDER, or delete that folder first (rm -r {self.folder})."
            )

    def _lock(self, handle: int, kind: str) -> None:
        try:
            import fcntl
        except ImportError:  # no such locks on this system
            return
        try:
            fcntl.flock(handle, getattr(fcntl, kind) | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BusyFolderError(
                f"Another vpd-data is writing {self.folder}. Wait for it, or choose another out=FOLDER."
            ) from error
        except OSError:  # a file system without locks
            return


def _versions(packages: Sequence[str]) -> dict[str, str]:
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found
