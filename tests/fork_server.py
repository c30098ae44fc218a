"""Processes of their own without the seconds that importing PyTorch, Lightning and Hydra takes each time.

``popen`` is ``subprocess.Popen`` for ``python -m module`` and ``python -c code``: a server that has imported all that
forks for each. It is started when a test process first needs it, and computes nothing itself, so that a fork has one
thread and no state. Exit codes, streams, folder, environment, session and signals are those of a real start; what the
environment decides while Python or PyTorch starts (PYTHONHASHSEED, OMP_NUM_THREADS) is that of the server. Tests about
starting, about several ranks and about imports start real processes.
"""

import atexit
import contextlib
import functools
import gc
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from tests.cpu_seconds import add_command

ROOT = Path(__file__).resolve().parents[1]
PATHS = [str(ROOT / "src"), str(ROOT)]
PIPE, STDOUT, DEVNULL = subprocess.PIPE, subprocess.STDOUT, subprocess.DEVNULL
_LARGEST = 2**17  # bytes of a request


class Command:
    """What ``Popen`` offers of a running process, in text."""

    def __init__(self, args: Sequence[str], pid: int, status: IO[str], streams: Sequence[IO[str] | None]):
        self.args, self.pid, self.returncode = args, pid, None
        self.stdin, self.stdout, self.stderr = streams
        self._status = status

    def poll(self) -> int | None:
        return self._wait(0.0)

    def wait(self, timeout: float | None = None) -> int:
        if self._wait(timeout) is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        assert self.returncode is not None
        return self.returncode

    def _wait(self, timeout: float | None) -> int | None:
        if self.returncode is None and select.select([self._status], [], [], timeout)[0]:
            answer = self._status.readline()
            assert answer, "the fork server died"
            ended = json.loads(answer)
            self._status.close()
            add_command(ended["cpu_seconds"])
            self.returncode = ended["code"]
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def communicate(self, timeout: float | None = None) -> tuple[str | None, str | None]:
        """Read what it prints until it has ended, and return its output and its errors."""
        if self.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self.stdin.close()
        texts: dict[str, str] = {}

        def read(name: str, stream: IO[str]) -> None:
            with stream:
                texts[name] = stream.read()

        open_ones = {name: s for name in ("stdout", "stderr") if (s := getattr(self, name)) and not s.closed}
        readers = [threading.Thread(target=read, args=entry, daemon=True) for entry in open_ones.items()]
        for reader in readers:
            reader.start()
        for reader in readers:
            reader.join(timeout)
            if reader.is_alive():
                raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        self.wait(timeout)
        return texts.get("stdout"), texts.get("stderr")


def popen(
    args: Sequence[Any], *, cwd: Any = None, env: Mapping[str, str] | None = None, start_new_session: bool = False,
    stdin: int | None = None, stdout: int | None = None, stderr: int | None = None, text: bool = True,
) -> Command:  # fmt: skip
    """Start ``[sys.executable, "-m" or "-c", ...]`` by forking."""
    words = [str(word) for word in args]
    if words[0] != sys.executable or words[1] not in ("-m", "-c") or not text:
        raise ValueError(f"only `python -m` and `python -c`, in text: {words[:3]}")
    theirs, ours = [0, 1, 2], [None, None, None]
    made: list[int] = []
    for place, wanted in enumerate((stdin, stdout, stderr)):
        if wanted == PIPE:
            read, write = os.pipe()
            theirs[place], mine = (read, write) if place == 0 else (write, read)
            ours[place] = os.fdopen(mine, "w" if place == 0 else "r")  # type: ignore[call-overload]
            made.append(theirs[place])
        elif wanted == DEVNULL:
            theirs[place] = os.open(os.devnull, os.O_RDWR)
            made.append(theirs[place])
        elif wanted == STDOUT:
            theirs[place] = theirs[1]
        elif wanted is not None:
            theirs[place] = wanted
    status, their_status = os.pipe()
    request = {
        "words": words[1:],
        "cwd": str(Path(cwd or ".").absolute()),
        "env": dict(os.environ if env is None else env),
        "new_session": start_new_session,
        "ignores_interrupts": signal.getsignal(signal.SIGINT) == signal.SIG_IGN,
    }
    message = json.dumps(request).encode()
    assert len(message) < _LARGEST
    socket.send_fds(_server(), [message], [*theirs, their_status])
    for descriptor in [*made, their_status]:
        os.close(descriptor)
    answers = os.fdopen(status, "r", buffering=1)
    pid = answers.readline()
    assert pid, "the fork server died"
    return Command(words, int(pid), answers, ours)


def run(args: Sequence[Any], *, capture_output: bool = False, timeout: float | None = None, check: bool = False,
        **options: Any) -> subprocess.CompletedProcess[str]:  # fmt: skip
    """Start a command, wait for its end, and return what ``subprocess.run`` returns."""
    if capture_output:
        options |= {"stdout": PIPE, "stderr": PIPE}
    process = popen(args, **options)
    output, errors = process.communicate(timeout)
    assert process.returncode is not None
    done = subprocess.CompletedProcess(process.args, process.returncode, output, errors)
    if check:
        done.check_returncode()
    return done


@functools.cache
def _server() -> socket.socket:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*PATHS, *sys.path]), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.fork_server", str(theirs.fileno())]
    process = subprocess.Popen(command, cwd=ROOT, env=environment, pass_fds=[theirs.fileno()])
    theirs.close()
    _running.append((process, ours))
    return ours


_running: list[tuple[Any, socket.socket]] = []


def stop() -> None:
    """End the server, so that its processor seconds count."""
    for process, ours in _running:
        ours.close()
        process.wait()
    _running.clear()
    _server.cache_clear()


# The server


def serve(channel: socket.socket) -> dict[str, Any] | None:
    """Fork for each request. Returns None when there will be no more, and in each fork the request."""
    children: dict[int, tuple[int, int]] = {}  # descriptor of a process -> its number and where its end is reported
    while True:
        ready, _, _ = select.select([channel, *children], [], [])
        for descriptor in ready:
            if descriptor is not channel:
                _tell_end(descriptor, *children.pop(descriptor))
                continue
            message, descriptors, _, _ = socket.recv_fds(channel, _LARGEST, 4)
            if not message:
                return None
            begun, beginning = os.pipe()
            pid = os.fork()
            if pid == 0:
                request = json.loads(message)
                if request["new_session"]:
                    os.setsid()
                os.close(begun)
                os.close(beginning)
                channel.close()
                for entry in [*children, *(status for _, status in children.values()), descriptors[3]]:
                    os.close(entry)
                for place in range(3):
                    os.dup2(descriptors[place], place)
                for entry in set(descriptors[:3]) - {0, 1, 2}:
                    os.close(entry)
                return request
            os.close(beginning)
            os.read(begun, 1)  # until the child has its session: whoever gets its number may end the whole group
            os.close(begun)
            for entry in descriptors[:3]:
                os.close(entry)
            os.write(descriptors[3], f"{pid}\n".encode())
            children[os.pidfd_open(pid)] = (pid, descriptors[3])


def _tell_end(descriptor: int, pid: int, status: int) -> None:
    os.close(descriptor)
    _, ended, used = os.wait4(pid, 0)
    answer = {"code": os.waitstatus_to_exitcode(ended), "cpu_seconds": used.ru_utime + used.ru_stime}
    with contextlib.suppress(BrokenPipeError):  # nobody waits for it any more
        os.write(status, f"{json.dumps(answer)}\n".encode())
    os.close(status)


def become(request: dict[str, Any]) -> None:
    """Be the process that was asked for."""
    # A start has what its parent has at that time; the server has what its own parent had when it was started.
    signal.signal(signal.SIGINT, signal.SIG_IGN if request["ignores_interrupts"] else signal.default_int_handler)
    os.environ.clear()
    os.environ.update(request["env"])
    os.chdir(request["cwd"])
    tempfile.tempdir = None  # TMPDIR may be another one
    _seed_anew()
    how, what, *words = request["words"]
    given = [path for path in request["env"].get("PYTHONPATH", "").split(os.pathsep) if path]
    sys.path[:0] = [os.getcwd() if how == "-m" else "", *given]
    sys.argv = ["-c" if how == "-c" else what, *words]
    code = 1
    try:
        if how == "-m":
            sys.modules.pop(what, None)  # it runs anew, as __main__
            runpy.run_module(what, run_name="__main__", alter_sys=True)
        else:
            exec(compile(what, "<string>", "exec"), {"__name__": "__main__", "__builtins__": __builtins__})
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        if code and not isinstance(end.code, int):
            print(end.code, file=sys.stderr)
    except BaseException as error:
        sys.excepthook(type(error), error, error.__traceback__)
        code = -signal.SIGINT if isinstance(error, KeyboardInterrupt) else 1
    _end(code)


def _end(code: int) -> None:
    """End as Python does, but for taking its modules apart, which takes longer than most commands."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(BrokenPipeError, ValueError):
            stream.flush()
    if code < 0:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code & 255)


def _seed_anew() -> None:
    """Draw other numbers than the processes that were forked before, as a process does that is started."""
    import random

    import numpy as np
    import torch

    random.seed()
    np.random.seed()
    torch.seed()


def import_everything() -> None:
    """Import what commands need, and freeze it: memory that the collector does not touch stays shared."""
    import lightning.pytorch  # noqa: F401
    import tensorboard.summary  # noqa: F401
    import torch_geometric  # noqa: F401

    import vpd_lightning.commands.train
    import vpd_lightning.config  # noqa: F401
    import vpd_lightning.runs.training_run  # noqa: F401

    assert threading.active_count() == 1, "a fork has one thread"
    gc.freeze()


if __name__ == "__main__":
    import_everything()
    asked = serve(socket.socket(fileno=int(sys.argv[1])))
    if asked is not None:
        become(asked)
    os._exit(0)  # what is frozen would be reported as leaked
