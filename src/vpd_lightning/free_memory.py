"""Memory of this process: what it holds, what it may still take, and what the C library keeps although it is free."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import torch

_PROCESS, _SYSTEM = Path("/proc/self"), Path("/proc/meminfo")
# Limit of a container's memory, what it uses, and which part of that is files that can be read again; newer and older
# kernels.
_CONTAINERS = (
    (Path("/sys/fs/cgroup"), "memory.max", "memory.current", ("inactive_file", "active_file")),
    (
        Path("/sys/fs/cgroup/memory"),
        "memory.limit_in_bytes",
        "memory.usage_in_bytes",
        ("total_inactive_file", "total_active_file"),
    ),
)
_MARGIN = 256 * 2**20  # bytes left to the system: an allocation fails before the kernel kills


def return_free_memory() -> bool:
    """Hand memory that was freed back to the system; False where the C library has no way to (it is not glibc).

    Tensors whose sizes differ from update to update, such as edges, leave holes. glibc keeps them: a training whose
    largest update needs 2 GiB was seen to hold 8 GiB after a thousand updates, of which this gave back 5.
    """
    trim = _malloc_trim()
    if trim is None:
        return False
    trim(0)
    return True


@cache
def _malloc_trim() -> "ctypes._NamedFuncPointer | None":
    try:
        return ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):
        return None


def available_bytes(device: torch.device | str = "cpu") -> int | None:
    """Return how much more memory this process may take on a device; None where that is not known."""
    device = torch.device(device)
    if device.type == "cuda":
        kept = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + kept
    free = _size(_SYSTEM, "MemAvailable")
    if free is None:
        return None
    for folder, limit, used, files in _CONTAINERS:
        try:
            left = int((folder / limit).read_text()) - int((folder / used).read_text())
        except (OSError, ValueError):  # no container, or "max"
            continue
        free = min(free, left + sum(_size(folder / "memory.stat", name) or 0 for name in files))
    return max(free, 0)


def reset_peak(device: torch.device | str = "cpu") -> int | None:
    """Measure the largest use of memory anew; return what is used now (bytes), None where that cannot be measured."""
    device = torch.device(device)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return torch.cuda.memory_allocated(device)
    return_free_memory()
    try:
        (_PROCESS / "clear_refs").write_text("5")
    except OSError:
        return None
    return _size(_PROCESS / "status", "VmRSS")


def peak_bytes(device: torch.device | str = "cpu") -> int | None:
    """Return the largest use of memory (bytes) since ``reset_peak``; None where that cannot be measured."""
    device = torch.device(device)
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return _size(_PROCESS / "status", "VmHWM")


@contextmanager
def limited_to_available() -> Iterator[None]:
    """Let an allocation beyond what is available now fail with an error, instead of the system's killing the process.

    Does nothing where a CUDA device is in use, whose driver reserves addresses without bounds, or outside of Linux.
    """
    free, held = available_bytes(), _size(_PROCESS / "status", "VmData")
    if free is None or held is None or torch.cuda.is_available():
        yield
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = held + max(free - _MARGIN, 0)
    known = [bound for bound in (limit, soft, hard) if bound != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_DATA, (min(known), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _size(path: Path, name: str) -> int | None:
    """Return a line of the kernel's tables (``Name: 12 kB`` or ``name 12288``) in bytes; None where there is none."""
    try:
        lines = path.read_text().splitlines()
    except OSError:
        return None
    found = [line.split() for line in lines if line.split()[:1] in ([name], [f"{name}:"])]
    return int(found[0][1]) * (1024 if found[0][2:] == ["kB"] else 1) if found else None
