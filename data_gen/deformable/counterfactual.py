"""Soft bodies from one frame of their fall on, some of them taken away, moved or thrown otherwise."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.counterfactual import MAX_STATE_ERROR, Change, speed_after
from data_gen.deformable.drop import Drop, draw_drop
from data_gen.deformable.scene import prepare
from data_gen.deformable.settings import DeformableSettings
from data_gen.labels import Labels
from data_gen.renderers import Renderer, open_renderer
from vpd_lightning.data.ground_truth import read_state
from vpd_lightning.errors import DataError


class Counterfactual:
    """MuJoCo from the true state of a frame on, with bodies gone or elsewhere."""

    def __init__(self, settings: DeformableSettings, drop: Drop, frame: int):
        import mujoco

        self.settings, self.drop, self.frame = settings, drop, frame
        model, data, self.bodies = prepare(settings, drop)
        for _ in range(frame):
            mujoco.mj_step(model, data, settings.substeps)
            mujoco.mj_forward(model, data)  # as the recording was made
        self.positions = self.bodies.rest + data.qpos.reshape(-1, 3)
        self.velocities = data.qvel.reshape(-1, 3).copy()

    def start(self, changes: Mapping[int, Change]) -> tuple[Any, Any, Any]:
        """Return model, data and soft bodies of those that are not gone, after the changes."""
        kept = [body for body in range(len(self.drop.shapes)) if not changes.get(body, Change()).is_gone]
        drop = Drop(*(tuple(getattr(self.drop, item.name)[body] for body in kept) for item in fields(Drop)))
        model, data, bodies = prepare(self.settings, drop)
        places, speeds = [], []
        for body in kept:
            change, part = changes.get(body, Change()), self.bodies.parts[body]
            places.append(change.moved(self.positions[part]))
            speed = self.velocities[part] @ change.rotation().T
            if change.velocity is not None:
                wanted = speed_after(change.velocity, self.settings.frame_time, model.opt.gravity)
                speed = np.broadcast_to(wanted, speed.shape)
            speeds.append(speed)
        data.qpos[:] = (np.concatenate(places) - bodies.rest).ravel()
        data.qvel[:] = np.concatenate(speeds).ravel()
        return model, data, bodies

    def run(self, changes: Mapping[int, Change], num_steps: int) -> list[NDArray[np.float64]]:
        """Return the vertices (step, vertex, 3) of each body that is not gone, over the frames behind the first."""
        import mujoco

        model, data, bodies = self.start(changes)
        frames = []
        for _ in range(num_steps):
            mujoco.mj_step(model, data, self.settings.substeps)
            frames.append(bodies.rest + data.qpos.reshape(-1, 3))
        return [np.stack([points[part] for points in frames]) for part in bodies.parts]


def at_frame(settings: DeformableSettings, attributes: Mapping[str, Any], path: Path, frame: int) -> Counterfactual:
    """Return MuJoCo at a frame of a recording (``attributes`` of its file).

    Raises:
        DataError: the simulation does not repeat the recording.
    """
    drop = draw_drop(
        settings, int(attributes["seed"]), attributes["split"], int(attributes["index"]), int(attributes["attempt"])
    )
    found = Counterfactual(settings, drop, frame)
    recorded = read_state(path).vertices
    assert recorded is not None
    error = float(np.abs(found.positions - recorded[frame]).max())
    if error > MAX_STATE_ERROR:
        raise DataError(f"the simulation is {error:.2g} m off the recording: other versions, or another machine")
    return found


def begin(
    settings: DeformableSettings, attributes: Mapping[str, Any], path: Path, frame: int, changes: Mapping[int, Change]
) -> tuple[Any, Any, Renderer]:
    """Return model, data and renderer at a frame of a recording, after the changes.

    Raises:
        DataError: the simulation does not repeat the recording, or no body is left.
    """
    found = at_frame(settings, attributes, path, frame)
    count: Sequence[int] = [body for body in range(len(found.drop.shapes)) if not changes.get(body, Change()).is_gone]
    if not count:
        raise DataError("no body is left to simulate")
    model, data, _ = found.start(changes)
    labels = Labels(np.zeros(model.ngeom, np.uint8), np.arange(1, model.nflex + 1, dtype=np.uint8))
    return model, data, open_renderer(settings.renderer, model, settings, labels)
