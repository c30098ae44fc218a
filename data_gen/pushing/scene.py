"""A pusher moves among bodies on a table; what it does is written beside what the cameras see."""

from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_gen.pushing.bodies import PlacedBody, draw_bodies
from data_gen.pushing.model import PUSHER, compile_model, labels_of
from data_gen.pushing.motion import CommandedPath, draw_path
from data_gen.pushing.settings import PusherSettings, PushingSettings
from data_gen.renderers import open_renderer
from data_gen.rigid_bodies import RigidBodies
from data_gen.settings import SPLIT_CODES
from data_gen.simulate_and_render import simulate_and_render, trajectory_of
from data_gen.stage_clock import StageClock
from vpd_lightning.data import schema
from vpd_lightning.data.driven_motion import DrivenMotion

_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


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
        self.data.qpos[-2:] = path.at(0.0)
        self.data.ctrl[:] = path.at(0.0)
        self._index = self.model.body(PUSHER).id
        self._measured, self._commanded = (np.tile(np.eye(4), (settings.num_frames, 1, 1, 1)) for _ in range(2))

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

        self.data.ctrl[:] = self.path.at(self.data.time + self.settings.timestep)
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
        self._measured[frame, 0, :2, 3] = self.data.qpos[-2:]
        self._commanded[frame, 0, :2, 3] = self.path.at(self.data.time)
        for poses in (self._measured, self._commanded):
            poses[frame, 0, 2, 3] = self.settings.pusher_height

    def driven_motion(self) -> DrivenMotion:
        """Return points on the pusher's surface as it moved."""
        points, normals = cylinder_surface(self.settings.pusher)
        groups = np.zeros(len(points), np.int32)
        return DrivenMotion.carried(points, normals, groups, self._measured, self._commanded)


def cylinder_surface(pusher: PusherSettings) -> tuple[NDArray[Any], NDArray[Any]]:
    """Spread points evenly over an upright cylinder: points and outward normals (point, 3), from its middle, metres."""
    radius, half = pusher.radius, pusher.length / 2
    side, cap = 2 * half, radius / 2  # areas over 2 pi radius
    num_caps = round(pusher.num_points * cap / (side + 2 * cap))
    num_side = pusher.num_points - 2 * num_caps
    index = np.arange(num_side) + 0.5
    angle = index * _GOLDEN_ANGLE
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(num_side)], axis=1)
    points, normals = [outward * radius + [[0, 0, 1]] * (half * (2 * index / num_side - 1))[:, None]], [outward]
    for sign in (-1.0, 1.0):
        index = np.arange(num_caps) + 0.5
        away, angle = radius * np.sqrt(index / max(num_caps, 1)), index * _GOLDEN_ANGLE
        points.append(np.stack([away * np.cos(angle), away * np.sin(angle), np.full(num_caps, sign * half)], axis=1))
        normals.append(np.tile([0.0, 0.0, sign], (num_caps, 1)))
    return np.concatenate(points), np.concatenate(normals)
