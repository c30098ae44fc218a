"""Which mistakes in converting recordings ``vpd-data validate`` names, on exact data and under a sensor's noise.

``python -m docs.results.studies.planted_mistakes NAME=FOLDER ... --out docs/results/planted_mistakes.json``. Of each
data set's training split the first ``--recordings`` are taken, as they are and as a sensor of ``SENSORS`` would have
recorded their depth. Every mistake of ``MISTAKES`` is planted into all of them; a pose is off by ``POSE_OFF`` of the
median depth (3 cm at 1.4 m). ``verdict`` is "named" where an error has the words of the mistake (for a pose, those of
that view alone; for swapped cameras, that these two or the calibration are wrong), "one of two" where a pose's error
names another view beside, "another fault" where there is an error that says something else, "remark" where it is said
and passed, "cannot tell" where a remark lists what cannot be told. A late trigger has a study of its own
(``trigger_delay.py``).
"""

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.inspection.fault import Fault
from data_gen.inspection.validate import check_dataset
from tests.data_gen.inspection.mistakes import (
    Change,
    as_distance,
    inverted,
    opengl,
    positions_in_millimetres,
    scaled,
    shifted,
)
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.schema import Trajectory, write_trajectory
from vpd_lightning.data.sensors import Sensor, load_sensor
from vpd_lightning.data.sensors.sensor import median_depth
from vpd_lightning.files import AtomicPath

SENSORS: dict[str, dict[str, float]] = {"none": {}, "active_stereo": {"percent_at_median": 0.5}}
OFF_VIEW = 1
POSE_OFF = 0.03 / 1.4
NUM_FRAMES = 12


def _moved(axis: int) -> Change:
    def apply(trajectory: Trajectory) -> Trajectory:
        poses = trajectory.cam_to_world.copy()
        poses[..., OFF_VIEW, axis, 3] += POSE_OFF * median_depth(trajectory.depth[0], trajectory.far)
        return replace(trajectory, cam_to_world=poses)

    return apply


def _swapped(trajectory: Trajectory) -> Trajectory:
    order = [1, 0, *range(2, trajectory.depth.shape[1])]
    return replace(trajectory, cam_to_world=trajectory.cam_to_world[..., order, :, :])


_ALONE = (f"the pose of view {OFF_VIEW} is off",)
_SWAPPED = ("the pose of view 0 or view 1 is off", "are the cameras calibrated, and do their times agree?")
MISTAKES: dict[str, tuple[Change, tuple[str, ...]]] = {
    "nothing": (lambda trajectory: trajectory, ()),
    "axes of OpenGL": (opengl, ("the camera axes are OpenGL's",)),
    "distance along the ray": (as_distance, ("depth is the distance to the camera centre",)),
    "depth in millimetres": (scaled(1000.0), ("depth is in millimetres",)),
    "positions in millimetres": (positions_in_millimetres, ("the positions in cam_to_world are in millimetres",)),
    "cameras swapped": (_swapped, _SWAPPED),
    "poses inverted": (inverted, ("cam_to_world is world_to_cam: invert it",)),
    "a pose off along x": (_moved(0), _ALONE),
    "a pose off along y": (_moved(1), _ALONE),
    "a pose off along z": (_moved(2), _ALONE),
    "half a pixel": (shifted(0.5), ("the principal point has 0.5 too much",)),
}
_ONE_OF_TWO = (f"the pose of view {OFF_VIEW} or view", f"or view {OFF_VIEW} is off")


def recorded(path: Path, sensor: str) -> Trajectory:
    """Read some ``NUM_FRAMES`` frames of a recording, depth as the sensor measures it."""
    with TrajectoryReader(path) as reader:
        times = list(range(0, reader.num_frames, max(1, reader.num_frames // NUM_FRAMES)))
        depth = reader.depth(times)
        intrinsics, poses = reader.cameras(times)
        settings = load_sensor(sensor, SENSORS[sensor])
        if settings is not None:
            middle = median_depth(depth[0], reader.far)
            camera = Sensor(settings, seed=0, trajectory=path.stem, median_depth=middle)
            for moment, view in np.ndindex(*depth.shape[:2]):
                depth[moment, view] = camera.measure_depth(depth[moment, view], intrinsics[moment, view], moment, view)
        return Trajectory(
            rgb=reader.rgb(times),
            depth=depth,
            intrinsics=intrinsics,
            cam_to_world=poses,
            frame_time=reader.frame_time,
            near=reader.near,
            far=reader.far,
            workspace_min=reader.workspace_min,
            workspace_max=reader.workspace_max,
            seed=0,
        )


def judged(trajectories: Sequence[Trajectory], change: Change, words: Sequence[str]) -> dict[str, Any]:
    """Plant a mistake and return what is said of it."""
    with tempfile.TemporaryDirectory() as folder:
        for number, trajectory in enumerate(trajectories):
            write_trajectory(Path(folder) / f"{number:06d}.h5", change(trajectory))
        started = time.process_time()
        faults = check_dataset(Path(folder)).faults
        seconds = time.process_time() - started
    faults = [fault for fault in faults if fault.name != "manifest"]  # files without a manifest are meant here
    errors = [fault for fault in faults if fault.is_error]
    return {
        "verdict": verdict(faults, words),
        "faults": sorted({fault.name for fault in errors}),
        "seconds": seconds,
        "messages": sorted({fault.message for fault in faults}),
    }


def verdict(faults: Sequence[Fault], words: Sequence[str]) -> str:
    """Return the best that is said of a mistake with these words."""
    errors = [fault.message for fault in faults if fault.is_error]
    remarks = [fault.message for fault in faults if fault.name == "views_disagree"]
    if any(word in message for message in errors for word in words):
        return "named"
    if words == _ALONE and any(word in message for message in errors for word in _ONE_OF_TWO):
        return "one of two"
    if errors:
        return "another fault"
    if any(word in message for message in remarks for word in words):
        return "remark"
    return "cannot tell" if any(fault.name == "cannot_tell" for fault in faults) else "nothing"


def main(arguments: Sequence[str] | None = None) -> int:
    """Judge the data sets and write what was said."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="+", metavar="NAME=FOLDER")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--recordings", type=int, default=2)
    options = parser.parse_args(arguments)
    cells: dict[str, dict[str, Any]] = {}
    for word in options.data:
        name, _, folder = word.partition("=")
        paths = sorted(load_manifest(folder).splits["train"])[: options.recordings]
        for sensor in SENSORS:
            trajectories = [recorded(path, sensor) for path in paths]
            cells[f"{name}/{sensor}"] = {
                mistake: judged(trajectories, change, words) for mistake, (change, words) in MISTAKES.items()
            }
    with AtomicPath(options.out) as partial:
        partial.write_text(json.dumps({"num_recordings": options.recordings, "cells": cells}, indent=1) + "\n")
    for mistake in MISTAKES:
        print(f"{mistake:26s}" + " | ".join(f"{name} {cell[mistake]['verdict']}" for name, cell in cells.items()))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
