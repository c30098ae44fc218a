"""Blender's process: where its Python is, starting it, asking it, and what is said when it fails."""

import atexit
import collections
import contextlib
import os
import select
import subprocess
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from data_gen.blender import messages
from vpd_lightning.errors import ConfigError, RenderingBackendError

VARIABLE = "VPD_BLENDER_PYTHON"
_FOLDER = ".venv-blender"
_JOB = Path(__file__).with_name("job.py")
_START_TIMEOUT = 300.0  # s; the first start reads 800 MB from disk
_CHUNK = 1 << 20
_KEPT_LINES = 5


def find_python() -> Path:
    """Return the Python of Blender's environment.

    ``VPD_BLENDER_PYTHON`` names it; else ``.venv-blender`` in the current folder or beside the checkout.

    Raises:
        ConfigError: there is none; the message says how to make it.
    """
    given = os.environ.get(VARIABLE)
    if given:
        if not Path(given).is_file():
            raise ConfigError(f"{VARIABLE} is {given}, which is not a file. It names the Python that has bpy.")
        return Path(given)
    for folder in (Path.cwd(), Path(__file__).resolve().parents[2]):
        python = folder / _FOLDER / "bin" / "python"
        if python.is_file():
            return python
    raise ConfigError(
        "renderer=blender needs Blender's Python module in an environment of its own (1 GB), and there is none.\n"
        f"Make it: python3.11 -m venv {_FOLDER} && {_FOLDER}/bin/pip install bpy==5.0.1 OpenEXR (or `make blender`),\n"
        f"and run from that folder, or set {VARIABLE} to its bin/python."
    )


class BlenderProcess:
    """A running Blender that answers one request after the other; ends with this process.

    ``command`` gets a folder for temporary files as its last word; both sides remove it.
    """

    def __init__(self, command: list[str], start_timeout: float = _START_TIMEOUT) -> None:
        self.owner: object | None = None  # whose scene it holds
        self._lines: collections.deque[str] = collections.deque(maxlen=_KEPT_LINES)
        self._folder = tempfile.TemporaryDirectory(prefix="vpd-blender-", ignore_cleanup_errors=True)
        # A group of its own: Ctrl-C in a terminal must not kill it before the worker has left in order.
        try:
            self._child = subprocess.Popen(
                [*command, self._folder.name],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                process_group=0,
            )
        except OSError as error:
            self._folder.cleanup()
            raise RenderingBackendError(f"Blender's Python cannot be started: {error}.") from error
        assert self._child.stdin and self._child.stdout and self._child.stderr
        self._input, self._output = self._child.stdin.fileno(), self._child.stdout.fileno()
        os.set_blocking(self._input, False)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        self._deadline = time.monotonic() + start_timeout
        self.version = str(self._receive("start")[0].get("blender", "?"))

    @property
    def is_alive(self) -> bool:
        """Whether it can be asked."""
        return self._child.poll() is None

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._child.pid

    def ask(
        self, head: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], timeout: float
    ) -> tuple[dict[str, Any], messages.Arrays]:
        """Send a request and return the answer.

        Raises:
            RenderingBackendError: Blender died, failed, or did not answer in ``timeout`` seconds; after dying or
                silence the process is gone.
        """
        self._deadline = time.monotonic() + timeout
        doing = str(head["kind"])
        self._send(messages.pack(head, arrays), doing)
        answer, values = self._receive(doing)
        if answer.get("kind") == "error":
            raise RenderingBackendError(f"Blender failed on a {doing}: {answer.get('message')}")
        return answer, values

    def close(self) -> None:
        """End it."""
        for stream in (self._child.stdin, self._child.stdout):
            assert stream
            with contextlib.suppress(OSError):
                stream.close()
        try:
            self._child.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._listener.join(timeout=5)
        if self._child.stderr and not self._listener.is_alive():
            self._child.stderr.close()
        self._folder.cleanup()

    def _send(self, message: bytes, doing: str) -> None:
        rest = memoryview(message)
        while rest:
            _, writable, _ = select.select([], [self._input], [], self._seconds_left(doing))
            if not writable:
                continue
            try:
                rest = rest[os.write(self._input, rest[:_CHUNK]) :]
            except BlockingIOError:
                continue
            except BrokenPipeError:
                raise self._died(doing) from None

    def _receive(self, doing: str) -> tuple[dict[str, Any], messages.Arrays]:
        def read(count: int) -> bytes:
            data = bytearray()
            while len(data) < count:
                readable, _, _ = select.select([self._output], [], [], self._seconds_left(doing))
                if not readable:
                    continue
                piece = os.read(self._output, min(_CHUNK, count - len(data)))
                if not piece:
                    raise self._died(doing)
                data += piece
            return bytes(data)

        try:
            return messages.unpack(read)
        except ValueError as error:
            self._kill()
            raise RenderingBackendError(f"Blender's answer to a {doing} is garbled: {error}.") from error

    def _seconds_left(self, doing: str) -> float:
        left = self._deadline - time.monotonic()
        if left <= 0:
            self._kill()
            raise RenderingBackendError(
                f"Blender did not answer in time ({doing}) and was stopped.{self._last_words()}"
            )
        return left

    def _died(self, doing: str) -> RenderingBackendError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._child.wait(timeout=5)  # it has closed its output: its own exit code is more telling than ours
        self._kill()
        return RenderingBackendError(
            f"Blender's process ended during: {doing} (exit code {self._child.returncode}).{self._last_words()}"
        )

    def _kill(self) -> None:
        self._child.kill()
        self._child.wait()
        self._listener.join(timeout=5)

    def _last_words(self) -> str:
        said = " | ".join(self._lines)
        return f"\nIts last words: {said[-400:]}" if said else ""

    def _listen(self) -> None:
        """Keep the last lines of what it prints; without a reader it would stop when the pipe is full."""
        assert self._child.stderr
        for line in self._child.stderr:
            text = line.decode(errors="replace").strip()
            if text:
                self._lines.append(text)


_running: BlenderProcess | None = None


def shared_process() -> BlenderProcess:
    """Return this process's Blender, started on first use and again after it died."""
    global _running
    if _running is None or not _running.is_alive:
        if _running is not None:
            _running.close()
        # Isolated: PYTHONPATH and the like of this environment are not for the other one.
        _running = BlenderProcess([str(find_python()), "-I", "-B", str(_JOB)])
        atexit.register(_running.close)
    return _running
