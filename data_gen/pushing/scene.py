"""A pusher moves among bodies on a table; what it does is written beside what the cameras see."""

from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_gen.pushing.arm import joints_of, link_poses, link_surfaces, place_of
from data_gen.pushing.bodies import PlacedBody, draw_bodies
from data_gen.pushing.model import compile_model, labels_of
from data_gen.pushing.motion import CommandedPath, draw_path
from data_gen.pushing.settings import PushingSettings
from data_gen.renderers import open_renderer
from data_gen.rigid_bodies import RigidBodies
from data_gen.settings import SPLIT_CODES
from data_gen.simulate_and_render import simulate_and_render, trajectory_of
from data_gen.stage_clock import StageClock
from vpd_lightning.data import schema
from vpd_lightning.data.driven_motion import DrivenMotion


class PushingScene:
    """Simulates and renders trajectories; each has a model and a renderer of its own."""

    def __init__(self, settings: PushingSettings, renderer: str) -> None:
        self.settings = settings
        self.backend = renderer

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
        settings, clock = self.settings, clock or StageClock()
        generator = np.random.default_rng([seed, SPLIT_CODES[split], index])
        with clock.measure("simulate"):
            bodies = draw_bodies(settings, generator)
            pushing = Pushing(settings, bodies, draw_path(settings, bodies, _duration(settings), generator))
        observed = RigidBodies(pushing.data, num_bodies=len(bodies), num_frames=settings.num_frames)
        with clock.measure("render"):
            renderer = open_renderer(self.backend, pushing.model, settings, labels_of(pushing.model, len(bodies)))

        def observe(frame: int) -> None:
            observed.observe(frame)
            pushing.begin_frame(frame)

        try:
            pictures = simulate_and_render(
                settings, pushing.model, pushing.data, renderer, clock, check_stop, observe, pushing.step
            )
        finally:
            renderer.close()
        return trajectory_of(
            settings,
            pictures,
            state=observed.state(half_sizes=np.stack([body.half_sizes for body in bodies])),
            action=pushing.driven_motion().as_arrays(),
            seed=seed,
            engine=f"mujoco {version('mujoco')}, {renderer.name}",
            scene_hash=scene_hash,
            attributes={
                "split": split,
                "index": index,
                "objects": ",".join(body.shape for body in bodies),
                "masses": np.array([body.mass for body in bodies]),  # kg
                "frictions": np.array([body.friction for body in bodies]),
                "camera_delay": settings.camera_delay,  # s
            },
        )


def _duration(settings: PushingSettings) -> float:
    return settings.num_frames * settings.frame_time


class Pushing:
    """One simulation: the pusher follows its commands, and its motion is noted ``camera_delay`` after each picture."""

    def __init__(self, settings: PushingSettings, bodies: list[PlacedBody], path: CommandedPath) -> None:
        import mujoco

        self.settings, self.path = settings, path
        self.model = compile_model(settings, bodies)
        self.data = mujoco.MjData(self.model)
        for number, body in enumerate(bodies):
            turn = Rotation.from_euler("z", body.yaw).as_quat(scalar_first=True)
            self.data.qpos[7 * number : 7 * number + 7] = [*body.place, body.half_sizes[2], *turn]
        self.data.qpos[-2:] = self.data.ctrl[:] = joints_of(settings, path.at(0.0))
        self._surfaces = link_surfaces(settings)
        shape = (settings.num_frames, int(self._surfaces[2].max()) + 1, 4, 4)
        self._measured, self._commanded = np.zeros(shape), np.zeros(shape)

    def begin_frame(self, frame: int) -> None:
        """Note the motion that goes with a picture; where pictures are late, that of a moment afterwards."""
        if not self.settings.delay_steps:
            self._note(frame)
        elif frame + 1 == self.settings.num_frames:
            self._later(frame)

    def step(self, frame: int) -> None:
        """Simulate from the frame before to ``frame``."""
        for number in range(self.settings.substeps):
            if number and number == self.settings.delay_steps:
                self._note(frame - 1)
            self._advance()

    def simulate_frame(self) -> None:
        """Simulate for the time of a frame without noting anything."""
        for _ in range(self.settings.substeps):
            self._advance()

    def branched(self, data: Any) -> "Pushing":
        """Return the same simulation on other data of the same model."""
        other = object.__new__(Pushing)
        other.__dict__.update(self.__dict__, data=data)
        return other

    def _advance(self) -> None:
        import mujoco

        self.data.ctrl[:] = joints_of(self.settings, self.path.at(self.data.time + self.settings.timestep))
        mujoco.mj_step(self.model, self.data)

    def _later(self, frame: int) -> None:
        """Note the motion after the last picture, and go back to the picture's moment."""
        import mujoco

        kept = mujoco.MjData(self.model)
        mujoco.mj_copyData(kept, self.model, self.data)
        for _ in range(self.settings.delay_steps):
            self._advance()
        self._note(frame)
        mujoco.mj_copyData(self.data, self.model, kept)

    def _note(self, frame: int) -> None:
        self._measured[frame] = link_poses(self.settings, self.data.qpos[-2:])
        self._commanded[frame] = link_poses(self.settings, joints_of(self.settings, self.path.at(self.data.time)))

    def driven_motion(self) -> DrivenMotion:
        """Return points on the surface of pusher and arm as they moved."""
        return DrivenMotion.carried(*self._surfaces, self._measured, self._commanded)

    @property
    def place(self) -> NDArray[np.float64]:
        """Where the pusher is (2,), metres."""
        return place_of(self.settings, self.data.qpos[-2:])
