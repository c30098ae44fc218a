"""Memory that was freed leaves the process, and what is beyond the limit fails where it is asked for."""

import ctypes
import platform
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from vpd_lightning import free_memory
from vpd_lightning.errors import OutOfMemoryError
from vpd_lightning.runs.training_errors import named_memory_errors

MIB = 2**20

HOLES = """
import ctypes, resource
from vpd_lightning.free_memory import return_free_memory

def held():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() >> 20

blocks = [bytearray(100_000) for _ in range(2000)]  # below the size from which glibc maps each block by itself
del blocks[:-1]  # the last one keeps the heap from shrinking
before = held()
assert return_free_memory()
print(before - held())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc" or sys.platform != "linux", reason="only glibc keeps it")
def test_holes_go_back_to_the_system():
    result = subprocess.run([sys.executable, "-c", HOLES], capture_output=True, text=True, check=True)

    assert int(result.stdout) > 100  # MiB, of 190


def test_another_c_library_is_left_alone(monkeypatch: pytest.MonkeyPatch):
    free_memory._malloc_trim.cache_clear()
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())

    assert not free_memory.return_free_memory()
    free_memory._malloc_trim.cache_clear()


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux says what a process held at most")
def test_the_peak_is_what_was_held_at_most_since_it_was_reset():
    before = free_memory.reset_peak()
    torch.ones(100 * MIB // 4).sum()
    assert before is not None and 95 * MIB < free_memory.peak_bytes() - before < 130 * MIB
    again = free_memory.reset_peak()
    assert again is not None and free_memory.peak_bytes() - again < 50 * MIB


@pytest.mark.skipif(sys.platform != "linux" or torch.cuda.is_available(), reason="no limit is set there")
def test_more_than_is_available_is_named_and_the_process_lives(monkeypatch: pytest.MonkeyPatch):
    import resource

    bounds = resource.getrlimit(resource.RLIMIT_DATA)
    monkeypatch.setattr(free_memory, "available_bytes", lambda: 600 * MIB)  # 256 of these are the system's
    for take in (lambda: torch.ones(500 * MIB // 4), lambda: bytearray(500 * MIB)):
        with pytest.raises(OutOfMemoryError, match=r"memory ran out.\nLower renderer"), named_memory_errors():
            take()
    with named_memory_errors():
        torch.ones(100 * MIB // 4)
    assert resource.getrlimit(resource.RLIMIT_DATA) == bounds


def test_a_container_may_allow_less_than_the_machine_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    kib = 1024
    (tmp_path / "meminfo").write_text("MemTotal: 9000 kB\nMemAvailable:    4000 kB\n")
    files = ("inactive_file", "active_file")
    monkeypatch.setattr(free_memory, "_SYSTEM", tmp_path / "meminfo")
    monkeypatch.setattr(
        free_memory, "_CONTAINERS", ((tmp_path / "none", "max", "used", files), (tmp_path, "max", "used", files))
    )
    for text, expected in (("max", 4000), (str(3000 * kib), 2000), (str(500 * kib), 0), (str(9000 * kib), 4000)):
        (tmp_path / "max").write_text(f"{text}\n")
        (tmp_path / "used").write_text(f"{1000 * kib}\n")
        assert free_memory.available_bytes() == expected * kib
    # Files that were read count as used, and make room where it is needed.
    (tmp_path / "max").write_text(str(1000 * kib))
    (tmp_path / "memory.stat").write_text(f"anon 5\ninactive_file {200 * kib}\nactive_file {300 * kib}\nfile 7\n")
    assert free_memory.available_bytes() == 500 * kib
    (tmp_path / "meminfo").unlink()
    assert free_memory.available_bytes() is None
