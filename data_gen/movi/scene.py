"""MOVi-like scenes: objects are thrown onto a floor and bounce, roll and push each other.

After Kubric's MOVi-A, B and C (Greff et al., 2022) with MuJoCo in Bullet's place and shapes made of formulas in the
place of its assets; see ``conf/data_gen/movi_*/`` for what is theirs, the paper's and ours.
"""

from collections.abc import Callable
from importlib.metadata import version

import numpy as np

from data_gen.movi.catalogue import Catalogue
from data_gen.movi.model import compile_model, labels_of
from data_gen.movi.settings import MoviSettings
from data_gen.movi.surroundings import draw_surroundings
from data_gen.movi.throwing import draw_objects, place
from data_gen.renderers import open_renderer
from data_gen.rigid_bodies import RigidBodies
from data_gen.settings import SPLIT_CODES
from data_gen.simulate_and_render import simulate_and_render, trajectory_of
from data_gen.stage_clock import StageClock
from vpd_lightning.data import schema


class MoviScene:
    """Simulates and renders trajectories; each has a model and a renderer of its own."""

    def __init__(self, settings: MoviSettings, renderer: str) -> None:
        self.settings = settings
        self.backend = renderer
        self.catalogue = Catalogue(settings.objects)

    def close(self) -> None:
        """Free everything (renderers do not outlive their trajectory)."""

    def trajectory(
        self,
        seed: int,
        split: str,
        index: int,
        scene_hash: str,
        check_stop: Callable[[], None] = lambda: None,
        clock: StageClock | None = None,
    ) -> schema.Trajectory:
        """Simulate and render one trajectory; ``check_stop`` is called before each frame and may raise."""
        import mujoco

        settings, clock = self.settings, clock or StageClock()
        generator = np.random.default_rng([seed, SPLIT_CODES[split], index])
        with clock.measure("simulate"):
            objects = draw_objects(settings, self.catalogue, generator)
            model = compile_model(settings, objects, draw_surroundings(settings.floor.look, generator))
            data = mujoco.MjData(model)
            place(settings, objects, model, data, generator)
        bodies = RigidBodies(data, num_bodies=len(objects), num_frames=settings.num_frames)
        with clock.measure("render"):
            renderer = open_renderer(self.backend, model, settings, labels_of(model))
        try:
            pictures = simulate_and_render(settings, model, data, renderer, clock, check_stop, bodies.observe)
        finally:
            renderer.close()
        attributes = {
            "split": split,
            "index": index,
            "objects": ",".join(thrown.item.name for thrown in objects),
            "materials": ",".join(thrown.material.name for thrown in objects),
            "sizes": np.array([thrown.size for thrown in objects]),  # m, longest side
            "masses": np.array([thrown.mass for thrown in objects]),  # kg
        }
        if settings.objects.mesh_folder is not None:
            attributes["mesh_hash"] = settings.objects.mesh_hash
        return trajectory_of(
            settings,
            pictures,
            state=bodies.state(half_sizes=np.stack([thrown.item.half_sizes for thrown in objects])),
            seed=seed,
            engine=f"mujoco {version('mujoco')}, {renderer.name}",
            scene_hash=scene_hash,
            attributes=attributes,
        )
