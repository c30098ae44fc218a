"""Trajectories of the MOVi-like scenes without pictures, so that no GL is needed."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from data_gen.movi.catalogue import Catalogue
from data_gen.movi.model import compile_model
from data_gen.movi.settings import MoviSettings
from data_gen.movi.surroundings import Surroundings
from data_gen.movi.throwing import ThrownObject, draw_objects, place
from data_gen.rigid_bodies import RigidBodies
from data_gen.settings import load_settings


@dataclass
class Throw:
    """The objects and the initial state of a trajectory."""

    settings: MoviSettings
    objects: list[ThrownObject]
    model: Any
    data: Any

    def simulate(self) -> RigidBodies:
        bodies = RigidBodies(self.data, len(self.objects), self.settings.num_frames)
        for frame in range(self.settings.num_frames):
            if frame:
                mujoco.mj_step(self.model, self.data, self.settings.substeps)
            mujoco.mj_forward(self.model, self.data)
            bodies.observe(frame)
        return bodies

    def corners(self, number: int) -> np.ndarray:
        """World positions of an object's vertices, as ``data`` stands."""
        mujoco.mj_kinematics(self.model, self.data)
        rotation, position = self.data.xmat[1 + number].reshape(3, 3), self.data.xpos[1 + number]
        return self.objects[number].item.mesh.vertices @ rotation.T + position


def thrown(scene: str, index: int = 0, **overrides: Any) -> Throw:
    settings = load_settings(MoviSettings, scene, "paper", overrides)
    generator = np.random.default_rng([7, 0, index])
    objects = draw_objects(settings, Catalogue(settings.objects), generator)
    model = compile_model(settings, objects, Surroundings((0.5, 0.5, 0.5)))
    data = mujoco.MjData(model)
    place(settings, objects, model, data, generator)
    return Throw(settings, objects, model, data)
