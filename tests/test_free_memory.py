"""Memory that was freed leaves the process."""

import ctypes
import platform
import subprocess
import sys

import pytest

from vpd_lightning import free_memory

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
