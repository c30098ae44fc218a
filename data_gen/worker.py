"""What runs in each worker process: one scene, built once, and one file per job."""

import os
import signal
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

from data_gen.simulated_sensor import measured, rendered_settings
from data_gen.stage_clock import StageClock
from vpd_lightning.data.sensors import SensorSettings

_state: dict[str, Any] = {}


class StopEvent(Protocol):
    """A flag that the parent sets when everybody should leave."""

    def is_set(self) -> bool:
        """Tell whether it is set."""
        ...


class Stopped(Exception):  # noqa: N818 - not an error: the parent asked for it
    """The parent is leaving."""


def environment(backend: str) -> dict[str, str]:
    """Return the variables that workers need before they import anything."""
    variables = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    if backend in ("egl", "osmesa"):
        # llvmpipe's own threads only disturb when every core has its own worker.
        variables |= {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend, "LP_NUM_THREADS": "0"}
    return variables


def start(
    family: str, settings: Any, backend: str, sensor: SensorSettings | None, stop_event: StopEvent | None
) -> None:
    """Build the scene of this process.

    With a ``stop_event`` this is a worker: Ctrl-C is left to the parent, which sets the event, and SIGTERM is noted and
    unwinds at the next frame, so that a half-written file is removed. Both signals arrive blocked (see
    ``data_gen.pool``).
    """
    if stop_event is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, _note)
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGTERM))
    rendered = settings if sensor is None else rendered_settings(settings, sensor)
    _state["scene"] = import_module(f"data_gen.{family}").Scene(rendered, backend)
    _state["sensor"], _state["settings"] = sensor, settings
    _state["storage"] = settings.storage
    _state["stop"] = stop_event
    _state["parent"] = os.getppid()


def stop() -> None:
    """Free the scene."""
    scene = _state.pop("scene", None)
    if scene is not None:
        scene.close()


@dataclass(frozen=True)
class MadeFile:
    """A finished trajectory: the SHA-256 of its file, and the CPU seconds of each stage."""

    sha256: str
    seconds: dict[str, float]


def make_file(seed: int, split: str, index: int, path: Path, scene_hash: str) -> MadeFile:
    """Simulate, render and write one trajectory."""
    from vpd_lightning.data.manifest import file_sha256
    from vpd_lightning.data.schema import write_trajectory

    clock, storage = StageClock(), _state["storage"]
    trajectory = _state["scene"].trajectory(seed, split, index, scene_hash, _check_stop, clock)
    if _state["sensor"] is not None:
        with clock.measure("render"):
            trajectory = measured(trajectory, _state["settings"], _state["sensor"], seed, f"{split}/{index:06d}")
    with clock.measure("write"):
        write_trajectory(path, trajectory, compression=storage.compression, depth_encoding=storage.depth_encoding)
        sha256 = file_sha256(path)
    return MadeFile(sha256, clock.seconds)


def _note(number: int, frame: FrameType | None) -> None:
    """Remember the signal; raising here could strike the pool's own code or a destructor, which print a traceback."""
    _state["signal"] = number


def _check_stop() -> None:
    event = _state["stop"]
    if event is None:
        return
    if "signal" in _state:
        raise SystemExit(128 + _state["signal"])
    if event.is_set():
        raise Stopped
    if os.getppid() != _state["parent"]:  # the parent was killed: nobody wants the rest
        raise Stopped
