"""Checkpoints that are whole or not there: written aside, flushed, renamed, and read only if all checksums hold."""

import hashlib
import io
import os
import pickle
import re
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from vpd_lightning.errors import CheckpointError
from vpd_lightning.files import PARTIAL_SUFFIX, AtomicPath

LAST = "last.ckpt"
PREVIOUS = "last-previous.ckpt"
BEST = "best.ckpt"

_IS_FOLDER = 0x10  # of MS-DOS file attributes, which PyTorch's reader looks at
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
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with AtomicPath(path) as partial:
            partial.write_bytes(buffer.getbuffer())
    except OSError as error:
        raise CheckpointError(
            f"{path} could not be written: {error.strerror or error}.\n"
            "The checkpoint before it is still whole. Make room or permit writing, then go on with resume=last."
        ) from error


def load_checkpoint(path: str | Path, map_location: Any = "cpu") -> dict[str, Any]:
    """Return the content of a checkpoint; see ``open_checkpoint``."""
    return open_checkpoint(path, map_location).content


def open_checkpoint(path: str | Path, map_location: Any = "cpu") -> OpenedCheckpoint:
    """Read a checkpoint: checksums first, then plain tensors and containers only (nothing in it can run).

    Raises CheckpointError where the file is missing, damaged, not a checkpoint, without weights, or on the internet.
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
        content = io.BytesIO(path.read_bytes())
    except FileNotFoundError:
        raise CheckpointError(
            f"There is no checkpoint {path}.\nCheck the path; runs keep theirs in checkpoints/."
        ) from None
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror or error}.") from error
    _require_whole(path, content)
    try:
        loaded = torch.load(content, map_location=map_location, weights_only=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"{path} holds more than tensors and plain containers, and is not opened.\n{str(error).splitlines()[0]}"
        ) from error
    except (RuntimeError, EOFError, ValueError) as error:  # PyTorch's reader is stricter about headers than zipfile
        raise CheckpointError(
            f"{path} is damaged, or not a checkpoint: {str(error).splitlines()[0]}\nUse another checkpoint of the run."
        ) from error
    return loaded, hashlib.sha256(content.getbuffer()).hexdigest()


def _require_whole(path: Path, content: io.BytesIO) -> None:
    """Check the CRC-32 of every member of the zip archive that ``torch.save`` writes; ``torch.load`` checks none."""
    if content.getbuffer()[:2] != b"PK":
        raise CheckpointError(f"{path} is not a checkpoint.\nUse one that vpd-train wrote.")
    try:
        with zipfile.ZipFile(content) as archive:
            broken = archive.testzip()
            # A member marked as a folder is not read by torch.load, which returns uninitialised memory in its place.
            folders = [member.filename for member in archive.infolist() if member.external_attr & _IS_FOLDER]
            broken = broken or next(iter(folders), None)
    # zipfile raises all of these where headers are damaged; RuntimeError is for what looks encrypted.
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError, struct.error) as error:
        broken = str(error)
    if broken is not None:
        raise CheckpointError(
            f"{path} is damaged or cut short: its checksums do not fit ({broken}).\nUse another checkpoint of the run."
        )
    content.seek(0)


def keep_previous(last: Path) -> None:
    """Give the present ``last.ckpt`` a second name, under which it survives its replacement."""
    if not last.is_file():
        return
    aside = last.with_name(f".{PREVIOUS}{PARTIAL_SUFFIX}")
    aside.unlink(missing_ok=True)
    try:
        os.link(last, aside)
        os.replace(aside, last.with_name(PREVIOUS))
    except OSError:  # a file system without hard links: for a moment only the previous one is there
        os.replace(last, last.with_name(PREVIOUS))
