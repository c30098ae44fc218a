"""The block from one frame of its throw on, taken away, moved or thrown otherwise."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_gen.counterfactual import MAX_STATE_ERROR, Change, speed_after
from data_gen.mujoco_block.scene import MujocoBlockScene, initial_state
from data_gen.mujoco_block.settings import MujocoBlockSettings
from data_gen.renderers import Renderer
from vpd_lightning.data.ground_truth import read_state
from vpd_lightning.errors import DataError

_OUT_OF_SIGHT = (1e3, 1e3, 1e3)  # metres


def begin(
    settings: MujocoBlockSettings, attributes: Mapping[str, Any], path: Path, frame: int, changes: Mapping[int, Change]
) -> tuple[Any, Any, Renderer]:
    """Return model, data and renderer at a frame of a recording (``attributes`` of its file), after the changes.

    Raises:
        DataError: the simulation does not repeat the recording.
    """
    import mujoco

    scene = MujocoBlockScene(settings, settings.renderer)
    model, data = scene.model, scene.data
    data.qpos[:], data.qvel[:] = initial_state(
        settings, int(attributes["seed"]), attributes["split"], int(attributes["index"])
    )
    for _ in range(frame):
        mujoco.mj_step(model, data, settings.substeps)
        mujoco.mj_forward(model, data)  # as the recording was made
    error = float(np.abs(data.qpos[:3] - read_state(path).positions[frame, 0]).max())
    if error > MAX_STATE_ERROR:
        raise DataError(f"the simulation is {error:.2g} m off the recording: other versions, or another machine")
    if 0 in changes:
        _change(data.qpos, data.qvel, changes[0], settings.frame_time, model.opt.gravity)
    return model, data, scene.renderer


def _change(
    place: NDArray[np.float64],
    motion: NDArray[np.float64],
    change: Change,
    frame_time: float,
    gravity: NDArray[np.float64],
) -> None:
    """Change the pose (7) and the velocity (6, angular in the body's frame) of a free joint."""
    if change.is_gone:
        place[:3], motion[:] = _OUT_OF_SIGHT, 0.0
        return
    place[:3] = change.moved(place[:3])
    turned = Rotation.from_quat(change.turn, scalar_first=True) * Rotation.from_quat(place[3:], scalar_first=True)
    place[3:] = turned.as_quat(scalar_first=True)
    motion[:3] = change.rotation() @ motion[:3]
    if change.velocity is not None:
        motion[:3], motion[3:] = speed_after(change.velocity, frame_time, gravity), 0.0
