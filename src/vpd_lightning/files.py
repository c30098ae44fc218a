"""Files and folders of results: complete or not there, and never written over."""

import os
import shutil
import tempfile
from pathlib import Path
from types import TracebackType

from vpd_lightning.errors import ConfigError

PARTIAL_SUFFIX = ".partial"


class AtomicPath:
    """Context manager: gives a temporary path beside ``path``, which becomes ``path`` when the block succeeds.

    What was written is flushed to disk before the rename; after an exception the temporary file is gone and ``path`` is
    as it was.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.partial: Path | None = None

    def __enter__(self) -> Path:
        handle, name = tempfile.mkstemp(dir=self.path.parent, prefix=f".{self.path.name}.", suffix=PARTIAL_SUFFIX)
        os.close(handle)
        self.partial = Path(name)
        return self.partial

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        assert self.partial is not None
        try:
            if kind is None:
                self.partial.chmod(0o644)
                _flush(self.partial)
                os.replace(self.partial, self.path)
                _flush(self.path.parent)
        finally:
            self.partial.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class OutputFolder:
    """Context manager: gives a temporary folder that becomes ``folder`` when the block succeeds, and else vanishes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.partial: Path | None = None

    def __enter__(self) -> Path:
        try:
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            name = tempfile.mkdtemp(dir=self.folder.parent, prefix=f".{self.folder.name}.", suffix=PARTIAL_SUFFIX)
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
