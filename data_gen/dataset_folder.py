"""The folder of a data set in the making: never mixed with something else, resumable, used by one process at a time."""

import json
import os
import platform
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from data_gen.settings import differences, settings_hash
from vpd_lightning.data.manifest import FILE_NAME, SPLITS, UNFINISHED_NAME, Manifest, load_manifest, write_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import DataError
from vpd_lightning.files import PARTIAL_SUFFIX, AtomicPath

_DISK_RESERVE = 64 * 2**20


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
    def claim(self) -> Iterator[None]:
        """Make the folder, keep other processes out of it, and note what it is to become."""
        try:
            for split in SPLITS:
                (self.folder / split).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DataError(f"{self.folder} cannot be written: {error.strerror}. Choose another out=FOLDER.") from error
        handle = os.open(self.folder, os.O_RDONLY)
        try:
            self._lock(handle)
            if (self.folder / FILE_NAME).exists():
                raise DataError(f"Another vpd-data has just finished {self.folder}. Run the command again to see it.")
            for folder in (self.folder, *(self.folder / split for split in SPLITS)):
                for left_over in folder.glob(f".*{PARTIAL_SUFFIX}"):  # of a killed process
                    left_over.unlink(missing_ok=True)
            with AtomicPath(self.folder / UNFINISHED_NAME) as partial:
                partial.write_text(json.dumps(self.identity, indent=1) + "\n")
            yield
        finally:
            os.close(handle)

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

    def _lock(self, handle: int) -> None:
        try:
            import fcntl
        except ImportError:  # no such locks on this system
            return
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise DataError(
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
