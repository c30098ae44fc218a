"""The robot in the mapping file of a ROS bag: its links' frames in tf, and their shapes from its URDF or MJCF."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.frame_times import Times
from data_gen.importers.robot_model import RobotModel, load_robot
from data_gen.importers.ros_transforms import TransformTree, frame_name
from data_gen.settings import did_you_mean
from vpd_lightning.data.driven_motion import DrivenMotion
from vpd_lightning.errors import ConfigError, DataError

_KEYS = ("model", "frames", "points")
_DEFAULT_POINTS = 256


@dataclass(frozen=True)
class TrackedRobot:
    """A robot's shapes, and the tf frame of each link that has one."""

    model: RobotModel
    frames: tuple[str, ...]

    def poses(
        self, tree: TransformTree, world: str, times: Times, max_gap: int, where: str
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return link to world (time, link, 4, 4), and at which times (ns) all links are known.

        Raises:
            DataError: tf has no such frame, or does not connect it with the world.
        """
        tracks, known = [], np.ones(len(times), bool)
        for link, frame in zip(self.model.link_names, self.frames, strict=True):
            if frame_name(frame) not in tree.frames:
                raise DataError(
                    f"{where}: tf has no frame {frame!r} for the robot's link {link!r}.\nName it in mapping=FILE "
                    f"(robot: frames: {{{link}: FRAME}}). Frames in the bag: {', '.join(tree.frames[:12]) or 'none'}."
                )
            poses, is_known = tree.poses(frame, world, times, max_gap)
            tracks.append(poses)
            known &= is_known
        return np.stack(tracks, axis=1), known

    def motion(self, poses: NDArray[np.float64]) -> DrivenMotion:
        """Carry the points along poses (time, link, 4, 4)."""
        return self.model.motion(poses)


def read_ros_robot(entry: Any, mapping: Path) -> TrackedRobot:
    """Read the part ``robot`` of a mapping; the model's file lies beside the mapping, unless its path is absolute.

    Raises:
        ConfigError: unknown or wrong entries, a model that cannot be read, or a link that it does not have.
    """
    where = f"{mapping}: robot"
    if not isinstance(entry, dict) or not isinstance(entry.get("model"), str):
        raise ConfigError(f"{where}: 'model' with the path of a URDF or MJCF was expected.")
    for key in entry:
        if key not in _KEYS:
            raise ConfigError(f"{where}: unknown key {key!r}{did_you_mean(str(key), _KEYS)}\nKeys: {', '.join(_KEYS)}.")
    num_points = entry.get("points", _DEFAULT_POINTS)
    if not isinstance(num_points, int) or not 1 <= num_points <= 100_000:
        raise ConfigError(f"{where}: points is {num_points!r}; allowed: 1 to 100,000.")
    frames = entry.get("frames", {})
    if not isinstance(frames, dict) or not all(isinstance(name, str) for pair in frames.items() for name in pair):
        raise ConfigError(f"{where}: frames is {frames!r}; the tf frame of each link was expected (LINK: FRAME).")
    model = load_robot(mapping.parent / Path(entry["model"]).expanduser(), num_points)
    links = model.link_names
    for link in frames:
        if link not in links:
            raise ConfigError(
                f"{where}: {model.path} has no link {link!r} with a shape{did_you_mean(link, tuple(links))}\n"
                f"Links: {', '.join(links)}."
            )
    return TrackedRobot(model, tuple(frames.get(link, link) for link in links))
