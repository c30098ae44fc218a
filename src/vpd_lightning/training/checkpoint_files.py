"""Checkpoints that are whole or not there: written aside, flushed, renamed, and read only if their checksum holds."""

import hashlib
import io
import os
import pickle
import re
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from vpd_lightning.errors import CheckpointError

LAST = "last.ckpt"
PREVIOUS = "last-previous.ckpt"
BEST = "best.ckpt"

# The checksum is the comment of the zip archive that a checkpoint is: one file, one rename, and still a zip archive.
_MARK = b"vpd-sha256:"
_TRAILER_LENGTH = len(_MARK) + 64
_PARTIAL_SUFFIX = ".partial"
_ADDRESS = re.compile(r"^[A-Za-z][A-Za-z0-9+.-]+:/")


@dataclass(frozen=True)
class OpenedCheckpoint:
    """A checkpoint that was read, checked and hashed once; ``sha256`` is that of the whole file."""

    path: Path
    content: dict[str, Any]
    sha256: str


def write_checkpoint(content: dict[str, Any], path: Path) -> None:
    """Write ``path`` so that at every moment it is either absent, the old file, or the complete new file."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    archive = buffer.getbuffer()
    body, comment_length = archive[:-2], bytes(archive[-2:])
    if comment_length != b"\0\0":
        raise CheckpointError(f"{path}: torch.save wrote an archive that has a comment already; nothing was written.")
    trailer = _MARK + hashlib.sha256(body).hexdigest().encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    # In the same folder: a rename across file systems would be a copy, which can be cut short.
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=_PARTIAL_SUFFIX)
    try:
        with os.fdopen(handle, "wb") as stream:
            for part in (body, len(trailer).to_bytes(2, "little"), trailer):
                stream.write(part)
            stream.flush()
            os.fchmod(stream.fileno(), 0o644)
            os.fsync(stream.fileno())
        os.replace(name, path)
    except OSError as error:
        raise CheckpointError(
            f"{path} could not be written: {error.strerror or error}.\n"
            "The checkpoint before it is still whole. Make room or permit writing, then go on with resume=last."
        ) from error
    finally:
        Path(name).unlink(missing_ok=True)
    _flush_folder(path.parent)


def load_checkpoint(path: str | Path, map_location: Any = "cpu") -> dict[str, Any]:
    """Return the content of a checkpoint; see ``open_checkpoint``."""
    return open_checkpoint(path, map_location).content


def open_checkpoint(path: str | Path, map_location: Any = "cpu") -> OpenedCheckpoint:
    """Read a checkpoint of ours: checksum first, then plain tensors and containers only (nothing in it can run).

    Raises CheckpointError where the file is missing, damaged, not ours, without weights, or an internet address.
    """
    loaded, sha256 = _read(path, map_location)
    if not isinstance(loaded, dict) or "state_dict" not in loaded:
        raise CheckpointError(f"{path} holds no weights (no state_dict).\nUse a checkpoint that vpd-train wrote.")
    return OpenedCheckpoint(Path(path), loaded, sha256)


def read_checkpoint(path: str | Path, map_location: Any) -> Any:
    """Read what ``load_checkpoint`` reads, weights or not."""
    return _read(path, map_location)[0]


def _read(path: str | Path, map_location: Any) -> tuple[Any, str]:
    """Return what a checkpoint holds, and the SHA-256 of the file."""
    if _ADDRESS.match(str(path)):
        raise CheckpointError(f"{path} is an internet address.\nFetch the file first, then give its path.")
    path = Path(path)
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise CheckpointError(
            f"There is no checkpoint {path}.\nCheck the path; runs keep theirs in checkpoints/."
        ) from None
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror or error}.") from error
    trailer = content[-_TRAILER_LENGTH:]
    if not trailer.startswith(_MARK):
        what = "is cut short, or another program wrote it" if content[:2] == b"PK" else "is not a checkpoint"
        raise CheckpointError(f"{path} {what}: it does not end in our checksum.\nUse another checkpoint of the run.")
    body = memoryview(content)[: -_TRAILER_LENGTH - 2]
    length_fits = content[-_TRAILER_LENGTH - 2 : -_TRAILER_LENGTH] == _TRAILER_LENGTH.to_bytes(2, "little")
    digest = hashlib.sha256(body)
    if not length_fits or digest.hexdigest().encode() != trailer[len(_MARK) :]:
        raise CheckpointError(f"{path} is damaged: its checksum does not fit.\nUse another checkpoint of the run.")
    try:
        loaded = torch.load(io.BytesIO(content), map_location=map_location, weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, zipfile.BadZipFile, EOFError, ValueError) as error:
        raise CheckpointError(
            f"{path} holds more than tensors and plain containers, and is not opened.\n{str(error).splitlines()[0]}"
        ) from error
    digest.update(content[len(body) :])
    return loaded, digest.hexdigest()


def keep_previous(last: Path) -> None:
    """Give the present ``last.ckpt`` a second name, under which it survives its replacement."""
    if not last.is_file():
        return
    aside = last.with_name(f".{PREVIOUS}{_PARTIAL_SUFFIX}")
    aside.unlink(missing_ok=True)
    try:
        os.link(last, aside)
        os.replace(aside, last.with_name(PREVIOUS))
    except OSError:  # a file system without hard links: for a moment only the previous one is there
        os.replace(last, last.with_name(PREVIOUS))


def _flush_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
