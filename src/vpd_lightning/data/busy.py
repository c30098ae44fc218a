"""Telling a file that another program holds open from one that is damaged."""

import errno
import os
from pathlib import Path

from vpd_lightning.data.hdf5.broken_file import BrokenFileError, refuse

KIND = "busy"
_NUMBERS = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EBUSY, errno.ETXTBSY)
# HDF5 gives these no number of their own.
_MARKED_OPEN, _OPEN_IN_HERE = "already open for write", "file locking flag values don't match"
_MAX_NAMED = 3
_OURSELVES = "this program itself"


def busy_error(path: Path, error: BaseException) -> BrokenFileError | None:
    """Return the error that says who holds the file, or None where nobody does and ``error`` is about its bytes."""
    text = str(error)
    # Handles of our own are left out: HDF5 may keep one of a file that was closed.
    writers = [name for name in _programs(path, writing=True) if name != _OURSELVES]
    is_marked = _MARKED_OPEN in text
    if not (writers or is_marked or _OPEN_IN_HERE in text or getattr(error, "errno", None) in _NUMBERS):
        return None
    holders = writers or _programs(path, writing=False)
    who = f"held open by {', '.join(holders[:_MAX_NAMED])}" if holders else "held open by another program"
    way_out = "The file is intact. Close it in that program, then try again."
    if is_marked and not holders:
        who = "marked as open for writing, but no visible process has it open"
        way_out = f"Where a program was killed while it wrote, `h5clear -s {path}` removes the mark; validate it then."
    return refuse(path, KIND, f"is busy ({who})", way_out)


def _programs(path: Path, *, writing: bool) -> list[str]:
    """Name the processes that have a file open (for writing), where the system lists them (Linux does)."""
    wanted = str(path.resolve())
    try:
        processes = [name for name in os.listdir("/proc") if name.isdigit()]
    except OSError:
        return []
    return [_name(int(process)) for process in processes if _holds(process, wanted, writing=writing)]


def _holds(process: str, wanted: str, *, writing: bool) -> bool:
    """Compare names: nothing that a process has open is touched, which could be a disk that does not answer."""
    folder = f"/proc/{process}/fd"
    try:
        handles = os.listdir(folder)
    except OSError:  # ended meanwhile, or another user's
        return False
    for handle in handles:
        try:
            if os.readlink(f"{folder}/{handle}") == wanted and (not writing or _writes(f"{folder}info/{handle}")):
                return True
        except OSError:
            continue
    return False


def _writes(facts: str) -> bool:
    flags = next(line for line in Path(facts).read_text().splitlines() if line.startswith("flags:"))
    return int(flags.split()[1], 8) & os.O_ACCMODE != os.O_RDONLY


def _name(process: int) -> str:
    if process == os.getpid():
        return _OURSELVES
    try:
        return f"{Path(f'/proc/{process}/comm').read_text().strip()} (process {process})"
    except OSError:
        return f"process {process}"
