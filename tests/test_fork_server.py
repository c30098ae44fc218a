"""A command that was forked behaves like one that was started."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests import fork_server
from tests.waiting import HANG

ROOT = Path(__file__).resolve().parents[1]
WAYS = [subprocess.run, fork_server.run]


def both(words: list[str], **options: Any) -> list[subprocess.CompletedProcess[str]]:
    """Start the same in both ways."""
    given = {"capture_output": True, "text": True, "timeout": HANG, **options}
    return [way([sys.executable, *words], **given) for way in WAYS]


@pytest.mark.parametrize(
    "code",
    [
        "print('fine')",
        "import sys; print(sys.argv, file=sys.stderr); sys.exit(7)",
        "import sys; sys.exit('said')",
        "import os, sys; print(os.getcwd(), os.environ['WORD'], 'PATH' in os.environ)",
        "import os; os.kill(os.getpid(), 9)",
        "import signal, os; print(signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))",
        "import atexit; atexit.register(print, 'at the end')",
        "import sys; print(repr(sys.stdin.read()), sys.stdin.isatty(), __name__)",
        "import threading; print(threading.active_count(), threading.current_thread().name)",
        "raise KeyboardInterrupt",
    ],
)
def test_a_fork_ends_and_prints_like_a_start(code: str, tmp_path: Path) -> None:
    environment = {"PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}", "WORD": "a b"}
    started, forked = both(["-c", code, "one", "two"], cwd=tmp_path, env=environment, stdin=subprocess.DEVNULL)

    assert (forked.returncode, forked.stdout) == (started.returncode, started.stdout)
    assert forked.stderr.splitlines()[-1:] == started.stderr.splitlines()[-1:]


def test_an_error_shows_its_traceback(tmp_path: Path) -> None:
    started, forked = both(["-c", "def broken():\n    return 1 // 0\nbroken()"])

    assert forked.returncode == started.returncode == 1
    assert "in broken" in forked.stderr
    assert forked.stderr.splitlines()[-1] == started.stderr.splitlines()[-1] != ""


@pytest.mark.parametrize("words", [["experiment=nothing"], ["experiment=tiny", "--cfg", "job", "-p", "renderer"]])
def test_a_command_answers_alike(words: list[str], tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}"}
    started, forked = both(["-m", "vpd_lightning.commands.train", *words], cwd=tmp_path, env=environment)

    assert (forked.returncode, forked.stdout, forked.stderr) == (started.returncode, started.stdout, started.stderr)


@pytest.mark.parametrize("start", [subprocess.Popen, fork_server.popen])
def test_it_is_signalled_read_and_waited_for(start: Callable[..., Any]) -> None:
    code = "import os, sys; print(os.getpid(), os.getpgid(0) == os.getpid(), flush=True); sys.stdin.read()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    process = start([sys.executable, "-c", code], text=True, start_new_session=True, **pipes)

    assert process.stdout.readline() == f"{process.pid} True\n"
    assert process.poll() is None and process.returncode is None
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.01)
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=HANG) == ("", None)
    assert process.returncode == process.wait() == process.poll() == -signal.SIGTERM
    process.kill()  # it has ended: nothing happens


def test_what_one_command_does_another_does_not_see(tmp_path: Path) -> None:
    for _ in range(2):
        started, forked = both(["-c", "import torch; print(hasattr(torch, 'mark')); torch.mark = 1"])
        assert forked.stdout == started.stdout == "False\n"


def test_forks_draw_different_numbers() -> None:
    code = "import random, numpy, torch; print(random.random(), numpy.random.random(), torch.rand(1).item())"
    one, other = (fork_server.run([sys.executable, "-c", code], capture_output=True).stdout.split() for _ in range(2))
    assert len(one) == 3 and not set(one) & set(other)
