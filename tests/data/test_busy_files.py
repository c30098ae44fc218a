"""A file that another program holds open, or that the system does not let us read, is not called damaged."""

import errno
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import pytest

from tests.data.recordings import write_recordings
from vpd_lightning.data.hdf5 import checks as hdf5_checks
from vpd_lightning.data.hdf5.broken_file import BrokenFileError
from vpd_lightning.data.hdf5.checks import open_file
from vpd_lightning.data.reader import TrajectoryReader

_HOLD = """
import sys, h5py
file = h5py.File(sys.argv[1], sys.argv[2], libver=sys.argv[3] or None)
if sys.argv[2] != "r":
    file.attrs["note"] = 1
print("held", flush=True)
sys.stdin.read()
"""
_OPEN = """
import sys, pathlib
from vpd_lightning.data.hdf5.checks import open_file
open_file(pathlib.Path(sys.argv[1]))
"""


@pytest.fixture
def trajectory(tmp_path: Path) -> Path:
    return next(write_recordings(tmp_path / "data").glob("**/*.h5"))


@contextmanager
def held(path: Path, mode: str, version: str = "", **environment: str) -> Iterator[subprocess.Popen[str]]:
    """Another process that has the file open until the block ends."""
    words = [sys.executable, "-c", _HOLD, str(path), mode, version]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, env={**os.environ, **environment}, **pipes) as process:  # type: ignore[call-overload]
        try:
            assert process.stdout.readline() == "held\n"
            yield process
        finally:
            process.communicate("")


def refused(path: Path) -> BrokenFileError:
    with pytest.raises(BrokenFileError) as caught, TrajectoryReader(path) as reader:
        reader.rgb()
    assert "damaged" not in str(caught.value) and "elete" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("version", ["latest", "v110"])
def test_a_file_that_is_written_elsewhere_is_busy_and_its_holder_named(trajectory: Path, version: str) -> None:
    with held(trajectory, "r+", version) as process:
        error = refused(trajectory)
        assert error.kind == "busy"
        assert "try again" in str(error)
        if sys.platform == "linux":
            assert f"(process {process.pid})" in str(error)
    with TrajectoryReader(trajectory) as reader:
        assert reader.num_frames, "it is as it was once it is closed"


def test_a_file_that_is_made_anew_elsewhere_is_busy(trajectory: Path) -> None:
    if sys.platform != "linux":
        pytest.skip("only Linux says who has a file open")
    with held(trajectory, "w"):
        assert refused(trajectory).kind == "busy"


def test_a_lock_that_the_system_insists_on_is_busy(trajectory: Path) -> None:
    """With HDF5_USE_FILE_LOCKING=TRUE the library locks, whatever it is asked for, and gives BlockingIOError."""
    with held(trajectory, "r+"):
        command = [sys.executable, "-c", _OPEN, str(trajectory)]
        environment = {**os.environ, "HDF5_USE_FILE_LOCKING": "TRUE"}
        result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert "is busy" in result.stderr and "BlockingIOError" in result.stderr, result.stderr


def test_a_file_that_is_open_in_this_very_program_is_busy(trajectory: Path) -> None:
    with h5py.File(trajectory, "r"):
        error = refused(trajectory)
    assert error.kind == "busy"
    if sys.platform == "linux":
        assert "this program itself" in str(error)


def test_a_mark_that_a_killed_writer_left_is_explained(trajectory: Path) -> None:
    with held(trajectory, "r+", "latest") as process:
        process.kill()
        process.wait()
    error = refused(trajectory)
    assert error.kind == "busy" and f"h5clear -s {trajectory}" in str(error)


@pytest.mark.parametrize("number", [errno.EACCES, errno.EMFILE, errno.EIO])
def test_what_the_system_refuses_is_not_called_damaged(
    trajectory: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(hdf5_checks.h5py, "File", refuse)
    with pytest.raises(BrokenFileError) as caught:
        open_file(trajectory)
    assert caught.value.kind == "unreadable" and os.strerror(number) in str(caught.value)
    assert "elete" not in str(caught.value)


def test_a_damaged_file_is_still_called_damaged(trajectory: Path) -> None:
    trajectory.write_bytes(trajectory.read_bytes()[:2000])
    with pytest.raises(BrokenFileError, match="damaged") as caught:
        open_file(trajectory)
    assert caught.value.kind == "damaged_file"
