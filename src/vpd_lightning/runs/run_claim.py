"""A run folder belongs to one process at a time, and a start that died makes room for the next."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import IO

from vpd_lightning.errors import ConfigError

CLAIM = ".claimed"
# What a training may have written when it dies before its first checkpoint.
_OWN = (
    CLAIM, "log.txt", "config*.yaml", "environment*.json", "overrides.yaml", "metrics.csv", ".metrics.csv.*.partial",
    "hparams.yaml", "events.out.tfevents.*", "checkpoints", "validation", "wandb",
    "pretraining", "slots", "training_time.json",
)  # fmt: skip


@contextmanager
def claimed(folder: Path, *, is_new: bool) -> Iterator[None]:
    """Take the folder for this run, new or resumed: two runs must not mix.

    The claim is a locked file. It goes when the run ends; where the process is killed the file stays, without its lock.

    Raises:
        ConfigError: another run has taken the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / CLAIM
    with _locked_file(path, is_new=is_new) as stream:
        stream.write(f"{os.getpid()}\n")
        stream.flush()
        try:
            yield
        finally:
            with suppress(OSError):  # the disk may be what ended the run
                path.unlink(missing_ok=True)


def _locked_file(path: Path, *, is_new: bool) -> IO[str]:
    """Open and lock the claim that has the path: the owner before may remove its file between the two."""
    while True:
        try:
            stream = path.open("x" if is_new else "a")
        except FileExistsError as error:
            raise ConfigError(
                f"another run has just taken {path.parent}.\nStart again, or name another run.folder."
            ) from error
        if not lock(stream):
            stream.close()
            raise ConfigError(f"another process trains in {path.parent}.\nWait for it, or stop it.")
        if _is_at(stream, path):
            return stream
        stream.close()


def _is_at(stream: IO[str], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(stream.fileno()), path.stat())
    except FileNotFoundError:
        return False


def is_claimed(folder: Path) -> bool:
    """Whether a process that is alive trains in the folder (as far as its file system knows locks)."""
    try:
        stream = (folder / CLAIM).open("r+")
    except OSError:
        return False
    with stream:
        return not lock(stream)


def foreign_files(folder: Path) -> list[str]:
    """Name what lies in a run folder and no training has written there before its first checkpoint."""
    return sorted(path.name for path in folder.iterdir() if not any(path.match(pattern) for pattern in _OWN))


def set_aside(folder: Path) -> Path:
    """Rename the folder to the first free ``<folder>.aborted-<number>`` and return that."""
    folder = folder.absolute()
    target = next(path for path in _aside(folder) if not path.exists())
    try:
        folder.rename(target)
    except OSError as error:
        raise ConfigError(
            f"{folder} holds a start without a checkpoint and cannot be renamed ({error.strerror}).\n"
            "Delete it, or name another run.folder."
        ) from error
    return target


def _aside(folder: Path) -> Iterator[Path]:
    return (folder.with_name(f"{folder.name}.aborted-{number}") for number in count(1))


def lock(stream: IO[str], *, is_patient: bool = False) -> bool:
    """Lock a file open for writing until it is closed; False where another process has done so.

    ``is_patient`` waits for the other process instead.
    """
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        return True
    try:
        # Unlike flock's, not inherited by loader workers.
        fcntl.lockf(stream, fcntl.LOCK_EX | (0 if is_patient else fcntl.LOCK_NB))
    except (BlockingIOError, PermissionError):
        return False
    except OSError:  # a file system without locks
        return True
    return True
