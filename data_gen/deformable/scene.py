"""Deformable Block, Multi and Collision: soft bodies are dropped onto a floor; RGB-D cameras watch from a half dome.

The paper simulated and rendered these with Blender's soft bodies (mass-spring); here MuJoCo's flexes (finite elements)
move and GL draws. The paper gives counts, frames, views, resolution and workspace; everything else is ours, see the
comments in ``conf/data_gen/deformable_block/paper.yaml``.
"""

from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np

from data_gen.deformable.drop import Drop, draw_drop
from data_gen.deformable.model import build_model, vertex_masses
from data_gen.deformable.settings import DeformableSettings
from data_gen.deformable.soft_bodies import SimulationFailedError, SoftBodies
from data_gen.labels import Labels
from data_gen.renderers import open_renderer
from data_gen.simulate_and_render import simulate_and_render, trajectory_of
from data_gen.stage_clock import StageClock
from vpd_lightning.data import schema
from vpd_lightning.errors import DataError


class DeformableScene:
    """Simulates and renders trajectories; the bodies, and so the model, are others in each."""

    def __init__(self, settings: DeformableSettings, renderer: str) -> None:
        self.settings = settings
        self.renderer = renderer

    def close(self) -> None:
        """Nothing is kept between trajectories."""

    def trajectory(
        self,
        seed: int,
        split: str,
        index: int,
        scene_hash: str,
        check_stop: Callable[[], None] = lambda: None,
        clock: StageClock | None = None,
    ) -> schema.Trajectory:
        """Simulate and render one trajectory; ``check_stop`` is called before each frame and may raise.

        A simulation that fails is tried again from another initial state; the attribute ``attempt`` says which one was
        kept (0 is the first).

        Raises:
            DataError: ``drop.max_attempts`` simulations failed.
        """
        failure = ""
        for attempt in range(self.settings.drop.max_attempts):
            try:
                return self._attempt(attempt, seed, split, index, scene_hash, check_stop, clock or StageClock())
            except SimulationFailedError as error:
                failure = str(error)
        number = self.settings.drop.max_attempts
        raise DataError(
            f"The simulation of {split} trajectory {index} failed {number} times ({failure}).\n"
            "Take a smaller timestep, a softer bodies.young or a lower drop.highest."
        )

    def _attempt(
        self,
        attempt: int,
        seed: int,
        split: str,
        index: int,
        scene_hash: str,
        check_stop: Callable[[], None],
        clock: StageClock,
    ) -> schema.Trajectory:
        settings = self.settings
        with clock.measure("simulate"):
            drop = draw_drop(settings, seed, split, index, attempt)
            model, data, bodies = prepare(settings, drop)
        labels = Labels(np.zeros(model.ngeom, np.uint8), np.arange(1, model.nflex + 1, dtype=np.uint8))
        with clock.measure("render"):
            renderer = open_renderer(self.renderer, model, settings, labels)
        try:
            pictures = simulate_and_render(settings, model, data, renderer, clock, check_stop, bodies.observe)
        finally:
            renderer.close()
        return trajectory_of(
            settings,
            pictures,
            state=bodies.state(),
            seed=seed,
            engine=f"mujoco {version('mujoco')}, {renderer.name}",
            scene_hash=scene_hash,
            attributes={"split": split, "index": index, "objects": ",".join(drop.shapes), "attempt": attempt},
        )


def prepare(settings: DeformableSettings, drop: Drop) -> tuple[Any, Any, SoftBodies]:
    """Return the model, its data in the initial state, and what notes its vertices."""
    import mujoco

    model = build_model(settings, drop.shapes, drop.meshes)
    data = mujoco.MjData(model)
    masses = [vertex_masses(mesh, settings.bodies.density) for mesh in drop.meshes]
    bodies = SoftBodies(data, drop.meshes, masses, settings.num_frames, settings.drop.max_speed)
    bodies.place(drop.vertices)
    return model, data, bodies
