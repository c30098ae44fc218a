"""How well ``vpd-data validate`` measures that one camera takes its pictures later than the others.

``python -m docs.results.studies.trigger_delay --root FOLDER --out docs/results/trigger_delay.json``. Data sets in the
folder are generated without a sensor and with about 10 ms between frames; of these every fourth or so is taken, and
for view 1 frames about 30 ms later. Sensors' errors are added to the depth, scaled to a noise of 0.2 % (active
stereo 0.5 %) at the scene's median depth. ``found_ms`` is what is
measured for view 1, ``error_ms`` its standard error, ``others_ms`` the worst of the other views; ``together_ms`` the
worst view where all are triggered together.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.inspection.trigger_delay import TriggerDelay, trigger_delays
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.schema import Trajectory, write_trajectory
from vpd_lightning.data.sensors import Sensor, load_sensor
from vpd_lightning.data.sensors.sensor import median_depth
from vpd_lightning.files import AtomicPath

SCENES = ("mujoco_block", "deformable_collision", "movi_a", "movi_b")
SENSORS: dict[str, dict[str, float]] = {
    "none": {},
    "structured_light": {"percent_at_median": 0.2},
    "active_stereo": {"percent_at_median": 0.5},
    "time_of_flight": {"percent_at_median": 0.2},
}
FRAME_TIME, DELAY = 0.045, 0.03  # s, as near as the data allow
LATE_VIEW = 1


def measure(paths: Sequence[Path], sensor: str) -> dict[str, Any]:
    """Measure recordings whose view 1 is late, and the same with all views together."""
    with tempfile.TemporaryDirectory() as folder:
        late, together = (
            [_record(path, sensor, is_late, Path(folder) / f"{is_late}_{path.name}") for path in paths]
            for is_late in (True, False)
        )
        started = time.process_time()
        found = trigger_delays([path for path, _ in late])
        seconds = time.process_time() - started
        correct = trigger_delays([path for path, _ in together])
    view = next(item for item in found if item.view == LATE_VIEW)
    return {
        "planted_ms": 1e3 * late[0][1],
        "frame_ms": 1e3 * view.frame_time,
        "found_ms": 1e3 * view.delay,
        "error_ms": 1e3 * view.error,
        "is_named": view.is_certain,
        "others_ms": _worst([item for item in found if item is not view]),
        "together_ms": _worst(correct),
        "is_false_alarm": any(item.is_certain for item in correct),
        "seconds": seconds,
    }


def _worst(found: Sequence[TriggerDelay]) -> float:
    return 1e3 * max(abs(item.delay) for item in found)


def _record(source: Path, sensor_name: str, is_late: bool, target: Path) -> tuple[Path, float]:
    """Write what the cameras would have recorded; return the file and by how much the late view is late (s)."""
    with TrajectoryReader(source) as reader:
        step, late = (max(1, round(length / reader.frame_time)) for length in (FRAME_TIME, DELAY))
        times = list(range(0, reader.num_frames - late, step))
        depth = reader.depth(times)
        if is_late:
            depth[:, LATE_VIEW] = reader.depth([time + late for time in times], [LATE_VIEW])[:, 0]
        intrinsics, poses = (part[0] for part in reader.cameras([0]))
        far, settings = reader.far, load_sensor(sensor_name, SENSORS[sensor_name])
        if settings is not None:
            middle = median_depth(depth[0], far)
            sensor = Sensor(settings, seed=0, trajectory=source.stem, median_depth=middle)
            for time, view in np.ndindex(*depth.shape[:2]):
                depth[time, view] = sensor.measure_depth(depth[time, view], intrinsics[view], time, view)
        trajectory = Trajectory(
            rgb=np.zeros((*depth.shape, 3), np.uint8),
            depth=depth,
            intrinsics=intrinsics,
            cam_to_world=poses,
            frame_time=step * reader.frame_time,
            near=reader.near,
            far=far,
            workspace_min=reader.workspace_min,
            workspace_max=reader.workspace_max,
            seed=0,
        )
        write_trajectory(target, trajectory)
        return target, late * reader.frame_time


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the scenes and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", default=",".join(SCENES))
    options = parser.parse_args(arguments)
    cells = {}
    for scene in options.scenes.split(","):
        paths = list(load_manifest(options.root / scene).splits["train"])
        for sensor in SENSORS:
            cell = cells[f"{scene}/{sensor}"] = measure(paths, sensor)
            print(f"{scene:20s} {sensor:16s} " + " ".join(f"{key} {value:.3g}" for key, value in cell.items()))
    result = {
        "command": "python -m docs.results.studies.trigger_delay",
        "num_recordings": len(paths),
        "cells": cells,
    }
    with AtomicPath(options.out) as partial:
        partial.write_text(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
