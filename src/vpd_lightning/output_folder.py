"""Folders of results: complete or not there, and never written over."""

import os
import shutil
import tempfile
from pathlib import Path
from types import TracebackType

from vpd_lightning.errors import ConfigError
from vpd_lightning.release.release_folder import WEIGHTS_FILE

RUNS = "runs"


def choose_folder(out: str | None, default: Path) -> Path:
    """Return where to write: ``out``, which must not exist, or the first free of ``default``, ``default_2``, ...

    Raises:
        ConfigError: ``out`` exists already.
    """
    if out is not None:
        folder = Path(out).expanduser()
        if folder.exists():
            raise ConfigError(f"{folder} exists already, and nothing is overwritten.\nGive another out=FOLDER.")
        return folder
    folder, number = default, 1
    while folder.exists():
        number += 1
        folder = default.with_name(f"{default.name}_{number}")
    return folder


def beside_checkpoint(path: Path, name: str) -> Path:
    """Return the folder ``name`` of the run that a checkpoint belongs to.

    A released model's folder stays as it is: its results go to ``runs/<its name>/`` below the current folder.
    """
    if path.name == WEIGHTS_FILE:
        return Path(RUNS).absolute() / path.absolute().parent.name / name
    return run_folder(path) / name


def run_folder(checkpoint: Path) -> Path:
    """Return the folder of the run that a checkpoint belongs to."""
    parent = checkpoint.absolute().parent
    return parent.parent if parent.name == "checkpoints" else parent


class OutputFolder:
    """Context manager: gives a temporary folder that becomes ``folder`` when the block succeeds, and else vanishes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.partial: Path | None = None

    def __enter__(self) -> Path:
        try:
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            name = tempfile.mkdtemp(dir=self.folder.parent, prefix=f".{self.folder.name}.", suffix=".partial")
        except OSError as error:
            raise ConfigError(f"Cannot write to {self.folder}: {error.strerror}.\nGive another out=FOLDER.") from error
        self.partial = Path(name)
        self.partial.chmod(0o755)
        return self.partial

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self.partial is not None
        try:
            if kind is None:
                if self.folder.exists():
                    raise ConfigError(f"{self.folder} was made by someone else in the meantime; nothing was written.")
                os.rename(self.partial, self.folder)
        finally:
            shutil.rmtree(self.partial, ignore_errors=True)
