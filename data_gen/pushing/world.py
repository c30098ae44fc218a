"""The pushing scene, moved step by step, as a robot would be in front of it: seen by the cameras of the data set."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.cameras import camera_intrinsics, camera_poses
from data_gen.pushing.arm import cylinder_surface
from data_gen.pushing.bodies import PlacedBody, draw_bodies
from data_gen.pushing.model import labels_of
from data_gen.pushing.motion import CommandedPath
from data_gen.pushing.scene import Pushing
from data_gen.pushing.settings import PushingSettings
from data_gen.renderers import Renderer, open_renderer
from vpd_lightning.errors import RenderingBackendError, one_line

_MAX_TRIALS = 1000


@dataclass(frozen=True)
class Observation:
    """One moment: pictures of all cameras, and where the pusher is (its middle, metres)."""

    rgb: NDArray[np.uint8]  # (view, height, width, 3)
    depth: NDArray[np.float32]  # (view, height, width) z-depth, m
    pusher: NDArray[np.float64]  # (3,)


class PushingWorld:
    """Bodies on the table and a pusher whose middle is commanded; time goes on frame by frame.

    A ``seed`` draws bodies and the pusher's place as those of the data set are drawn, but for pushers, which begin
    anywhere beside the bodies. ``backend`` null: without pictures.

    Raises:
        ValueError: an arm carries the pusher.
        RenderingBackendError: MuJoCo cannot draw by the backend in this process.
    """

    def __init__(self, settings: PushingSettings, seed: int, backend: str | None) -> None:
        if settings.arm.links:
            raise ValueError("a world to act in has a pusher that moves by itself: set arm.links=[]")
        generator = np.random.default_rng([seed, 90_210])
        self.settings = replace(settings, num_frames=1)
        self.bodies: list[PlacedBody] = draw_bodies(settings, generator)
        self.limit = np.asarray(settings.table.half_size) + settings.pusher.overhang
        start = self._free_place(generator)
        self._pushing = Pushing(self.settings, self.bodies, _standing(start))
        self.command = start
        self._renderer: Renderer | None = None
        import mujoco

        if backend is not None:
            labels = labels_of(self._pushing.model, len(self.bodies))
            try:
                self._renderer = open_renderer(backend, self._pushing.model, settings, labels)
            except mujoco.FatalError as error:
                raise RenderingBackendError(
                    f"MuJoCo was imported before it was known that {backend} draws ({one_line(error)}).\n"
                    f"Set MUJOCO_GL={backend} in the environment of the program."
                ) from error
        self.frame = 0
        mujoco.mj_forward(self._pushing.model, self._pushing.data)

    def _free_place(self, generator: np.random.Generator) -> NDArray[np.float64]:
        gap = self.settings.pusher.radius + self.settings.bodies.margin
        for _ in range(_MAX_TRIALS):
            place = generator.uniform(-self.limit, self.limit)
            if all(np.hypot(*(place - body.place)) > body.reach + gap for body in self.bodies):
                return place
        return self.limit

    @property
    def pusher(self) -> NDArray[np.float64]:
        """Where the pusher's middle is, as measured (3,), metres."""
        return np.array([*self._pushing.place, self.settings.pusher_height])

    @property
    def places(self) -> NDArray[np.float64]:
        """Where the centres of the bodies are (body, 3), metres."""
        return self._pushing.data.qpos[:-2].reshape(-1, 7)[:, :3].copy()

    @property
    def reaches(self) -> NDArray[np.float64]:
        """Farthest distance of each body from its upright axis at first (body,), metres."""
        return np.array([body.reach for body in self.bodies])

    @property
    def poses(self) -> NDArray[np.float64]:
        """Place and quaternion (w, x, y, z) of each body (body, 7)."""
        return self._pushing.data.qpos[:-2].reshape(-1, 7).copy()

    def advance(self, goals: Sequence[NDArray[np.float64]] | NDArray[np.float64]) -> None:
        """Command a place (2,) for the end of each of the next frames, and simulate up to the last of them.

        The command goes there evenly, no faster than the data set's fastest pusher, and stays within its limits.
        """
        most = self.settings.pusher.speed[1] * self.settings.frame_time
        for goal in np.asarray(goals, float).reshape(-1, 2):
            step = goal - self.command
            step = step * min(1.0, most / max(float(np.hypot(*step)), 1e-12))
            goal = np.clip(self.command + step, -self.limit, self.limit)
            begin = self._pushing.data.time
            self._pushing.path = _going(self.command, goal, begin, self.settings.frame_time)
            self._pushing.simulate_frame()
            self.command, self.frame = goal, self.frame + 1

    def observe(self) -> Observation:
        """Return pictures of this moment.

        Raises:
            ValueError: the world was made without a renderer.
        """
        import mujoco

        if self._renderer is None:
            raise ValueError("this world draws no pictures: give it a backend")
        camera = self.settings.camera
        shape = (camera.num_views, camera.height, camera.width)
        rgb, depth = np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32)
        mujoco.mj_forward(self._pushing.model, self._pushing.data)
        self._renderer.render(self._pushing.data, rgb, depth, np.empty(shape, np.uint8))
        return Observation(rgb, depth, self.pusher)

    def cameras(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return intrinsics (view, 3, 3) in pixels and cam_to_world (view, 4, 4) in metres."""
        return camera_intrinsics(self.settings.camera), camera_poses(self.settings.camera)

    def pusher_surface(self, pusher: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return points and normals on the pusher whose middle is there (point, 3)."""
        shape = self.settings.pusher
        points, normals = cylinder_surface(shape.radius, shape.length, shape.num_points)
        return points + pusher, normals

    def copy(self) -> "PushingWorld":
        """Return a world that goes on from here by itself, without pictures: what a planner with the truth may try."""
        import mujoco

        other = object.__new__(PushingWorld)
        other.__dict__.update(self.__dict__, _renderer=None)
        other._pushing = self._pushing.branched(mujoco.MjData(self._pushing.model))
        mujoco.mj_copyData(other._pushing.data, self._pushing.model, self._pushing.data)
        return other

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def _standing(place: NDArray[np.float64]) -> CommandedPath:
    return CommandedPath(np.stack([place, place]), np.array([0.0, 1.0]))


@dataclass(frozen=True)
class _Line(CommandedPath):
    """An even motion, unlike that of the data set, which starts and stops smoothly at each stop."""

    def at(self, time: float) -> NDArray[np.float64]:
        """Return the commanded place (2,) at a time (s)."""
        share = np.clip((time - self.times[0]) / (self.times[1] - self.times[0]), 0.0, 1.0)
        return self.places[0] + share * (self.places[1] - self.places[0])


def _going(begin: NDArray[np.float64], end: NDArray[np.float64], time: float, duration: float) -> CommandedPath:
    return _Line(np.stack([begin, end]), np.array([time, time + duration]))
