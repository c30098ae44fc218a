"""Settings of a simulated sensor: ``conf/sensor/NAME.yaml``, where their units and sources stand."""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from omegaconf import MISSING, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vpd_lightning.errors import ConfigError

NO_SENSOR = "none"


@dataclass
class SensorSettings:
    """What a sensor gets wrong; no value stands here, all of them stand in ``conf/sensor/``."""

    distances: list[float] = MISSING
    noise_percent: list[float] = MISSING
    percent_at_median: float | None = MISSING
    correlation_length: float = MISSING
    hole_share: float = MISSING
    hole_size: float = MISSING
    edge_dropout: float = MISSING
    flying_share: float = MISSING
    edge_step: float = MISSING
    grazing_degrees: float = MISSING
    grazing_bias: float = MISSING
    disparity_step: float = MISSING
    depth_step: float = MISSING
    exposure_percent: float = MISSING
    color_noise: float = MISSING
    pose_offset: float = MISSING
    pose_degrees: float = MISSING
    trigger_offset: float = MISSING
    trigger_steps: int = MISSING

    def __post_init__(self) -> None:
        for name in ("distances", "noise_percent"):
            values = list(getattr(self, name))
            if len(values) < 2 or values[0] <= 0 or any(a >= b for a, b in zip(values, values[1:], strict=False)):
                raise ValueError(f"{name} is {values}; allowed: two or more growing numbers above 0")
        if len(self.distances) != len(self.noise_percent):
            raise ValueError(
                f"distances and noise_percent are {len(self.distances)} and {len(self.noise_percent)} long"
            )
        percent = self.percent_at_median
        if percent is not None and not 0 < percent <= 10:
            raise ValueError(f"percent_at_median is {percent}; allowed: above 0, at most 10, or null")
        for name in ("hole_share", "edge_dropout", "flying_share"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; allowed: 0 to below 1")
        if self.edge_dropout + self.flying_share > 1:
            raise ValueError("edge_dropout and flying_share are shares of the same pixels: together at most 1")
        if not 0 < self.grazing_degrees < 90:
            raise ValueError(f"grazing_degrees is {self.grazing_degrees}; allowed: between 0 and 90")
        if not 1 <= self.trigger_steps <= 100:
            raise ValueError(f"trigger_steps is {self.trigger_steps}; allowed: 1 to 100")
        for name in (
            "correlation_length", "hole_size", "edge_step", "grazing_bias", "disparity_step", "depth_step",
            "exposure_percent", "color_noise", "pose_offset", "pose_degrees", "trigger_offset",
        ):  # fmt: skip
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}; allowed: 0 or more")


def sensor_names() -> list[str]:
    """Return the sensors that can be simulated."""
    return sorted(path.stem for path in _folder().glob("*.yaml"))


def load_sensor(name: str, changes: Mapping[str, Any] | None = None) -> SensorSettings | None:
    """Return the settings of a sensor with some of them changed; None for the perfect one.

    Raises:
        ConfigError: there is no such sensor or setting, or a value is out of range.
    """
    changes = dict(changes or {})
    if name not in sensor_names():
        near = _nearest(str(name), sensor_names())
        raise ConfigError(f"sensor={name} is unknown{near}\nAvailable: {', '.join(sensor_names())}.")
    if name == NO_SENSOR:
        if changes:
            raise ConfigError(f"sensor.{next(iter(changes))} says nothing without a sensor; add sensor=NAME.")
        return None
    known = [field.name for field in fields(SensorSettings)]
    for key in changes:
        if key not in known:
            raise ConfigError(f"Unknown setting sensor.{key}{_nearest(key, known)}\nSettings: {', '.join(known)}.")
    try:
        loaded = OmegaConf.load(_folder() / f"{name}.yaml")
        settings = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(SensorSettings), loaded, changes))
    except (OmegaConfBaseException, ValueError) as error:
        raise ConfigError(f"sensor={name}: {str(error).strip().splitlines()[0]}.") from error
    assert isinstance(settings, SensorSettings)
    return settings


def _nearest(value: str, known: list[str]) -> str:
    near = difflib.get_close_matches(value, known, n=1)
    return f"; did you mean {near[0]!r}?" if near else "."


def _folder() -> Path:
    """``conf/sensor``: inside the installed package, or at the root of a checkout."""
    package = Path(__file__).resolve().parents[2]
    candidates = [package / "conf" / "sensor", package.parents[1] / "conf" / "sensor"]
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise ConfigError(f"The sensors are missing: {candidates[0]} does not exist. Reinstall the package.")
