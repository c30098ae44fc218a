"""The pushing scene as a Gymnasium environment, so that agents of others can be compared with planning."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.pushing.settings import PushingSettings
from data_gen.pushing.world import PushingWorld
from data_gen.settings import load_settings
from vpd_lightning.errors import ConfigError
from vpd_lightning.planning.tasks import KINDS, draw_task

try:
    import gymnasium
except ImportError as error:
    raise ConfigError(
        "The pushing environment needs the package gymnasium, which is not installed.\n"
        "pip install vpd-lightning[planning]"
    ) from error


class PushingEnvironment(gymnasium.Env[dict[str, NDArray[Any]], NDArray[np.float32]]):
    """A pusher that is moved over a table with 1 to 4 bodies; the tasks are those of ``vpd-plan``.

    An action is the velocity of the pusher along x and y in shares of ``max_speed`` (m/s), for one frame (40 ms). The
    observation has ``rgb`` (view, height, width, 3), ``depth`` (view, height, width) in metres, the ``pusher`` (3,) in
    metres and the ``goal`` (2,). The reward is how much nearer to its goal the task came in this frame (metres), and
    one more when it is solved, which ends the episode; it is cut off after ``num_frames``. ``info`` has the true
    ``places`` of the bodies (body, 3), the cameras, and ``is_solved``.

    Raises:
        ConfigError: an unknown task or preset, or no GL backend.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012 (Gymnasium reads a dict)

    def __init__(
        self,
        task: str = "place",
        preset: str = "small",
        max_speed: float = 0.4,
        num_frames: int = 84,
        renderer: str | None = "auto",
        render_mode: str | None = None,
    ) -> None:
        if task not in KINDS:
            raise ConfigError(f"task={task} is unknown.\nAllowed: {', '.join(KINDS)}.")
        self.task_kind, self.max_speed, self.num_frames, self.render_mode = task, max_speed, num_frames, render_mode
        self.settings = load_settings(PushingSettings, "pushing", preset, {})
        self._backend: str | None = None
        if renderer is not None:
            from data_gen.gl_backend import choose_backend

            self._backend = choose_backend(renderer)
        camera = self.settings.camera
        shape = (camera.num_views, camera.height, camera.width)
        spaces: dict[str, gymnasium.Space[Any]] = {
            "pusher": gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32),
            "goal": gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32),
        }
        if self._backend is not None:
            spaces["rgb"] = gymnasium.spaces.Box(0, 255, (*shape, 3), np.uint8)  # type: ignore[arg-type]
            spaces["depth"] = gymnasium.spaces.Box(0, np.inf, shape, np.float32)
        self.observation_space = gymnasium.spaces.Dict(spaces)  # type: ignore[assignment]
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._world: PushingWorld | None = None

    @property
    def world(self) -> PushingWorld:
        """The simulation; there from the first ``reset`` on."""
        if self._world is None:
            raise RuntimeError("call reset() before step()")
        return self._world

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Draw bodies, the pusher's place and a task; the same seed draws the same."""
        import os

        super().reset(seed=seed)
        self.close()
        if self._backend is not None:
            os.environ["MUJOCO_GL"] = self._backend
        number = int(self.np_random.integers(2**31)) if seed is None else seed
        self._world = PushingWorld(self.settings, number, self._backend)
        generator = np.random.default_rng([number, KINDS.index(self.task_kind)])  # type: ignore[arg-type]
        half_size = np.asarray(self.settings.table.half_size)
        self.task = draw_task(self.task_kind, self.world.places, half_size, generator)  # type: ignore[arg-type]
        self._distance = self.task.distance(self.world.places)
        return self._observation(), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """Move the pusher for one frame."""
        velocity = np.clip(np.asarray(action, float), -1, 1) * self.max_speed
        self.world.advance((self.world.command + velocity * self.settings.frame_time)[None])
        distance = self.task.distance(self.world.places)
        gained, self._distance = self._distance - distance, distance
        is_solved = self.task.is_solved(self.world.places)
        is_over = self.world.frame >= self.num_frames
        return self._observation(), gained + float(is_solved), is_solved, is_over, self._info()

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Return the picture of the first camera, in the render mode ``rgb_array``."""
        return self.world.observe().rgb[0] if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the renderer."""
        if self._world is not None:
            self._world.close()
            self._world = None

    def _observation(self) -> dict[str, NDArray[Any]]:
        found: dict[str, NDArray[Any]] = {
            "pusher": self.world.pusher.astype(np.float32),
            "goal": self.task.goal.astype(np.float32),
        }
        if self._backend is not None:
            seen = self.world.observe()
            found |= {"rgb": seen.rgb, "depth": seen.depth}
        return found

    def _info(self) -> dict[str, Any]:
        intrinsics, poses = self.world.cameras()
        places = self.world.places
        is_solved = self.task.is_solved(places)
        return {"places": places, "intrinsics": intrinsics, "cam_to_world": poses, "is_solved": is_solved}
