"""What would have happened: a generated recording from one frame on, with bodies taken away, moved or thrown otherwise.

``python -m data_gen.counterfactual REQUEST.json OUT.npz`` does it in a process of its own, since GL wants its
environment before MuJoCo is imported; ``run_counterfactual`` calls it.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_gen.settings import checked_settings, load_preset
from vpd_lightning.data.manifest import Manifest, load_manifest
from vpd_lightning.errors import ConfigError, DataError

FAMILIES = ("mujoco_block", "deformable")
"""Packages of ``data_gen`` with a ``counterfactual`` module."""

MAX_STATE_ERROR = 1e-3
"""Metres that the repeated simulation may be off the recording, which holds 32-bit numbers."""


@dataclass(frozen=True)
class Change:
    """What happens to a body at the frame: gone; else turned about a point, shifted, and given a velocity.

    ``shift`` and ``about`` in metres, ``turn`` a quaternion (w, x, y, z), ``velocity`` in metres a frame over the frame
    before; None keeps its own, which turns along. A body that is given a velocity does not spin.
    """

    is_gone: bool = False
    shift: Sequence[float] = (0.0, 0.0, 0.0)
    turn: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
    about: Sequence[float] = (0.0, 0.0, 0.0)
    velocity: Sequence[float] | None = None

    def rotation(self) -> NDArray[np.float64]:
        """Return ``turn`` as a matrix."""
        from scipy.spatial.transform import Rotation

        matrix: NDArray[np.float64] = Rotation.from_quat(self.turn, scalar_first=True).as_matrix()
        return matrix

    def moved(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points (..., 3) turned about ``about``, then shifted."""
        about = np.asarray(self.about)
        result: NDArray[np.float64] = (points - about) @ self.rotation().T + about + np.asarray(self.shift)
        return result


def speed_after(velocity: Sequence[float], frame_time: float, gravity: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the velocity (m/s) at the end of a frame over which a falling body moved by ``velocity`` (metres)."""
    return np.asarray(velocity) / frame_time + 0.5 * frame_time * gravity


def family_of(manifest: Manifest) -> str | None:
    """Return the package that can simulate a data set anew; None where none can."""
    if not manifest.generator.startswith("vpd-data generate") or manifest.settings.get("sensor"):
        return None
    try:
        family, _ = load_preset(manifest.scene, manifest.preset)
    except ConfigError:  # a preset of somebody else's
        return None
    return family if family in FAMILIES else None


def run_counterfactual(
    manifest: Manifest, path: Path, frame: int, changes: Mapping[int, Change], num_steps: int
) -> NDArray[np.uint8]:
    """Return pictures (step, view, height, width, 3) of frames ``frame`` to ``frame + num_steps``.

    Args:
        manifest: of the data set.
        path: the trajectory's file.
        frame: where the changes happen; drawn as changed.
        changes: what happens to a body, by its number.
        num_steps: how many frames to simulate behind it.

    Raises:
        DataError: the data set cannot be simulated here, or not as it was recorded.
    """
    from data_gen.worker import environment

    if family_of(manifest) is None:
        raise DataError(f"{manifest.name} cannot be simulated anew: {', '.join(FAMILIES)} can.")
    backend = _backend(manifest)
    with tempfile.TemporaryDirectory() as folder:
        request, out = Path(folder) / "request.json", Path(folder) / "pictures.npz"
        words = {
            "folder": str(manifest.folder), "path": str(path), "frame": frame, "num_steps": num_steps,
            "changes": {str(body): asdict(change) for body, change in changes.items()},
        }  # fmt: skip
        request.write_text(json.dumps(words))
        done = subprocess.run(
            [sys.executable, "-m", "data_gen.counterfactual", str(request), str(out)],
            env=os.environ | environment(backend), capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise DataError(f"{manifest.name} could not be simulated anew: {last}")
        with np.load(out) as arrays:
            pictures: NDArray[np.uint8] = arrays["rgb"]
    return pictures


def _backend(manifest: Manifest) -> str:
    """Return what drew the recordings: ``raycast``, ``egl``, ``osmesa``, ``blender``; settings may say ``auto``."""
    return manifest.generator.rpartition(" ")[2]


def simulate(
    manifest: Manifest, path: Path, frame: int, changes: Mapping[int, Change], num_steps: int
) -> NDArray[np.uint8]:
    """Do what ``run_counterfactual`` asks for, in this process."""
    import h5py
    import mujoco

    family = family_of(manifest)
    assert family is not None
    package, (_, base) = import_module(f"data_gen.{family}"), load_preset(manifest.scene, manifest.preset)
    known = {key: value for key, value in manifest.settings.items() if key != "scene_version"}
    settings = checked_settings(package.Settings, base, known | {"renderer": _backend(manifest)}, f"{manifest.folder}")
    with h5py.File(path) as file:
        attributes = dict(file.attrs)
    begin = import_module(f"data_gen.{family}.counterfactual").begin
    model, data, renderer = begin(settings, attributes, path, frame, changes)
    camera = settings.camera
    shape = (camera.num_views, camera.height, camera.width)
    pictures = np.empty((num_steps + 1, *shape, 3), np.uint8)
    depth, labels = np.empty(shape, np.float32), np.empty(shape, np.uint8)
    try:
        for step in range(num_steps + 1):
            if step:
                mujoco.mj_step(model, data, settings.substeps)
            mujoco.mj_forward(model, data)
            renderer.render(data, pictures[step], depth, labels)
    finally:
        renderer.close()
    return pictures


def main() -> None:
    """Read the request, and write the pictures."""
    request = json.loads(Path(sys.argv[1]).read_text())
    changes = {int(body): Change(**words) for body, words in request["changes"].items()}
    manifest = load_manifest(request["folder"])
    rgb = simulate(manifest, Path(request["path"]), request["frame"], changes, request["num_steps"])
    np.savez(sys.argv[2], rgb=rgb)


if __name__ == "__main__":
    main()
