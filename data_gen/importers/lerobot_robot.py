"""The robot in the mapping file of a LeRobot data set: joint states become points on its links."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.conventions import checked_pose
from data_gen.importers.robot_model import RobotModel, load_robot
from data_gen.importers.source_files import choice
from data_gen.settings import did_you_mean
from vpd_lightning.data.driven_motion import DrivenMotion
from vpd_lightning.errors import ConfigError, DataError

_KEYS = ("model", "joints", "state", "command", "unit", "base", "points")
_UNITS = {"rad": "radians", "deg": "degrees"}
_DEFAULT_POINTS = 256


@dataclass(frozen=True)
class MappedRobot:
    """Which features say where the robot's joints are, and where they were asked to be; None for what is not said."""

    model: RobotModel
    joints: tuple[str | None, ...]
    state: str
    command: str | None
    unit: str
    base: NDArray[np.float64]  # (4, 4), the model's world to the cameras'

    @property
    def features(self) -> list[str]:
        """Names of the features that it needs."""
        return [self.state] if self.command is None else [self.state, self.command]

    def motion(self, numbers: Mapping[str, NDArray[np.float64]], where: str) -> DrivenMotion:
        """Return what the robot did in one episode (``numbers``: (time, number), by feature).

        Raises:
            DataError: a feature has another number of columns than there are joints, or is not finite.
        """
        poses = []
        for name in self.features:
            try:
                poses.append(self.model.poses(self.joints, numbers[name], self.unit, self.base))
            except DataError as error:
                raise DataError(f"{name} of {where}: {error}") from error
        return self.model.motion(*poses)


def read_robot(entry: Any, mapping: Path) -> MappedRobot:
    """Read the part ``robot`` of a mapping; the model's file lies beside the mapping, unless its path is absolute.

    Raises:
        ConfigError: unknown or missing entries, or a model that cannot be read or has other joints.
    """
    where = f"{mapping}: robot"
    if not isinstance(entry, dict):
        raise ConfigError(f"{where} is {entry!r}; model, joints, state and unit are needed.")
    for key in entry:
        if key not in _KEYS:
            raise ConfigError(f"{where}: unknown key {key!r}{did_you_mean(str(key), _KEYS)}\nKeys: {', '.join(_KEYS)}.")
    for key in ("model", "state", "command"):
        if not isinstance(entry.get(key), str) and (key in entry or key != "command"):
            raise ConfigError(f"{where}: {key!r} is {entry.get(key)!r}; a name is needed.")
    joints = entry.get("joints")
    if not isinstance(joints, list) or not joints or not all(isinstance(name, str | None) for name in joints):
        raise ConfigError(
            f"{where}: joints is {joints!r}; list the model's joint of each number of {entry['state']}, null for a "
            "number that is no joint's."
        )
    num_points = entry.get("points", _DEFAULT_POINTS)
    if not isinstance(num_points, int) or not 1 <= num_points <= 100_000:
        raise ConfigError(f"{where}: points is {num_points!r}; allowed: 1 to 100,000.")
    try:
        base = checked_pose(entry["base"], f"{where}: base") if "base" in entry else np.eye(4)
        unit = str(choice(entry, "unit", where, _UNITS))
    except DataError as error:  # the mapping is a setting, not data
        raise ConfigError(str(error)) from error
    model = load_robot(mapping.parent / Path(entry["model"]).expanduser(), num_points)
    model.addresses(joints)
    return MappedRobot(model, tuple(joints), entry["state"], entry.get("command"), unit, base)
