"""Frames of a trajectory as a simulated sensor would have recorded them: augmentation of a training."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8

from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.sensors.sensor import Sensor, median_depth
from vpd_lightning.data.sensors.settings import SensorSettings
from vpd_lightning.errors import ConfigError


class NoisyFrames(TrajectoryFrames):
    """A trajectory file, its depth, colours and poses with a sensor's errors; the same each time they are asked for.

    With ``use_cache`` the images as measured are kept.

    Raises:
        ConfigError: the sensor's cameras are triggered late, which needs frames that a recording does not have.
    """

    def __init__(self, path: Path, use_cache: bool, sensor: SensorSettings, seed: int) -> None:
        super().__init__(path, use_cache)
        if sensor.trigger_offset > 0:
            raise ConfigError(
                "A trigger offset needs frames between the recorded ones, which data.sensor has not.\n"
                "Generate such data: vpd-data generate ... sensor=NAME sensor.trigger_offset=SECONDS"
            )
        with TrajectoryReader(path) as reader:
            middle = median_depth(reader.depth([0]), reader.far)
        # The folder's name, not its place: the same data elsewhere gives the same errors.
        self._sensor = Sensor(sensor, seed=seed, trajectory=f"{path.parent.name}/{path.stem}", median_depth=middle)
        self._cam_to_world = np.stack(
            [self._sensor.measure_pose(self._cam_to_world[:, view], view) for view in range(self.num_views)], axis=1
        )
        self._measured_rgb: dict[tuple[int, int], np.ndarray] = {}
        self._measured_depth: dict[tuple[int, int], np.ndarray] = {}

    def rgb(self, times: Sequence[int], views: Sequence[int]) -> UInt8[np.ndarray, "time view height width 3"]:
        """Return the colours of the given frames and views, as measured."""
        return np.stack([np.stack([self._one_rgb(time, view) for view in views]) for time in times])

    def depth(self, times: Sequence[int], views: Sequence[int]) -> Float32[np.ndarray, "time view height width"]:
        """Return the z-depths in metres of the given frames and views, as measured; 0 where nothing was."""
        return np.stack([np.stack([self._one_depth(time, view) for view in views]) for time in times])

    def _one_rgb(self, time: int, view: int) -> UInt8[np.ndarray, "height width 3"]:
        if (time, view) in self._measured_rgb:
            return self._measured_rgb[time, view]
        measured = self._sensor.measure_rgb(super().rgb([time], [view])[0, 0], time, view)
        if self.use_cache:
            self._measured_rgb[time, view] = measured
        return measured

    def _one_depth(self, time: int, view: int) -> Float[np.ndarray, "height width"]:
        if (time, view) in self._measured_depth:
            return self._measured_depth[time, view]
        true = super().depth([time], [view])[0, 0]
        measured = self._sensor.measure_depth(true, self._intrinsics[time, view], time, view)
        if self.use_cache:
            self._measured_depth[time, view] = measured
        return measured
