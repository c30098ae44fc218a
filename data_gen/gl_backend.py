"""Which GL backend works on this machine, found out in child processes (a failing GL library may abort its process)."""

import functools
import os
import subprocess
import sys

from data_gen.worker import environment
from vpd_lightning.errors import RenderingBackendError

GL_BACKENDS = ("egl", "osmesa")
_TIMEOUT = 120  # s; the first start on a busy machine loads LLVM
_MARKER = "gl-backend-works"
_TRIAL = f"""
import mujoco
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><light pos="0 0 3"/><geom size=".2"/></worldbody></mujoco>')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 16, 16)
renderer.update_scene(data)
picture = renderer.render()
renderer.close()
print("{_MARKER}" if picture.max() > 0 else "the trial picture is black")
"""


def choose_backend(renderer: str) -> str:
    """Return ``egl`` or ``osmesa``, whichever is wanted and works; ``auto`` tries both in this order.

    Under ``auto`` a value of ``MUJOCO_GL`` in the environment is tried first.

    Raises:
        RenderingBackendError: nothing that is wanted works; the message names the Debian packages.
    """
    wanted = [renderer]
    if renderer == "auto":
        users = os.environ.get("MUJOCO_GL", "").lower()
        wanted = sorted(GL_BACKENDS, key=lambda name: name != users)
    reasons = []
    for backend in wanted:
        reason = why_not(backend)
        if reason is None:
            return backend
        reasons.append(f"{backend}: {reason}")
    raise RenderingBackendError(
        f"No GL rendering on this machine ({'; '.join(reasons)}).\n"
        "Install EGL:    apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0 libgl1\n"
        "or OSMesa:      apt-get install libosmesa6\n"
        "or do without:  scene=mujoco_block renderer=raycast needs no GL (same physics and depth, simpler shading)."
    )


def why_not(backend: str) -> str | None:
    """Render one small picture in a child process; return None if that works, else the reason in a few words."""
    try:
        trial = subprocess.run(
            [sys.executable, "-c", _TRIAL],
            env={**os.environ, **environment(backend)},
            capture_output=True,
            text=True,
            timeout=_TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"no answer within {_TIMEOUT} s"
    if _MARKER in trial.stdout:
        return None
    said = [line.strip() for line in (trial.stdout + trial.stderr).splitlines() if line.strip()]
    errors = [line for line in said if "Error" in line and "Exception ignored" not in line]
    return (errors or said or [f"the process ended with code {trial.returncode}"])[-1][:120]


@functools.cache
def working_backend() -> str | None:
    """Return the first GL backend that works here, or None; asked once per process."""
    return next((backend for backend in GL_BACKENDS if why_not(backend) is None), None)
