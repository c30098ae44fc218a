"""Nothing is fetched and nothing is sent: every command works where there is no network at all."""

import subprocess
import sys
from pathlib import Path

from tests.reliability.outcome import Outcome
from tests.reliability.trainings import environment, make_data, words

# A network namespace of its own has no interface but a loopback that is down.
_PREFIX = ("unshare", "--map-root-user", "--net")


# The page needs the loopback interface, which a process that owns its namespace may bring up.
_VIEW = """
import fcntl, socket, struct, sys, urllib.request
SIOCSIFFLAGS, IFF_UP, IFF_RUNNING = 0x8914, 0x1, 0x40
fcntl.ioctl(socket.socket(), SIOCSIFFLAGS, struct.pack("16sH14s", b"lo", IFF_UP | IFF_RUNNING, b""))
from vpd_lightning.commands.view import start
from vpd_lightning.config import compose
viewer = start(compose("view", sys.argv[1:]))
assert b"<html" in urllib.request.urlopen(viewer.url, timeout=60).read()
viewer.stop()
"""


def is_possible() -> bool:
    """Whether this machine lets us make a network namespace."""
    try:
        return subprocess.run([*_PREFIX, "true"], capture_output=True, timeout=10, check=False).returncode == 0
    except OSError:
        return False


def offline(work: Path) -> list[Outcome]:
    """Generate, check, train, evaluate, film, export, load and describe in an empty network namespace."""
    out, run, released = work / "data_offline", work / "offline", work / "offline_released"
    reached = _call("-c", "import socket; socket.create_connection(('127.0.0.1', 9), 5)")
    if "unreachable" not in reached.stderr:
        raise RuntimeError(f"the namespace is not empty: {reached.stderr[-200:]}")
    load = f"import vpd_lightning; vpd_lightning.load({str(released)!r})"
    commands = {
        "vpd-data generate": [
            *_module("data"),
            "generate",
            "scene=mujoco_block",
            "preset=tiny",
            f"out={out}",
            "seed=0",
        ],
        "vpd-data validate": [*_module("data"), "validate", str(out)],
        "vpd-train": [*_module("train"), *words(make_data(work / "data"), run, 6)],
        "vpd-eval": [*_module("eval"), f"ckpt={run}"],
        "vpd-render": [*_module("render"), f"ckpt={run}", f"out={work / 'offline_film'}"],
        "vpd-report": [*_module("report"), str(run), f"out={work / 'offline_report'}"],
        "vpd-export": [*_module("export"), f"ckpt={run}", f"out={released}"],
        "vpd_lightning.load": ["-c", load],
        "vpd-info": [*_module("info")],
        "vpd-view": ["-c", _VIEW, f"ckpt={run}", "port=0"],
    }
    failed = {name: done for name, command in commands.items() if (done := _call(*command)).returncode != 0}
    for name, done in failed.items():
        print(f"{name} ended with {done.returncode}: {done.stderr[-1500:]}{done.stdout[-500:]}")
    return [
        Outcome("commands worked without any network", len(commands), len(commands) - len(failed), ", ".join(commands))
    ]


def _module(name: str) -> tuple[str, str]:
    return "-m", f"vpd_lightning.commands.{name}"


def _call(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*_PREFIX, sys.executable, *arguments],
        env=environment(), capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
