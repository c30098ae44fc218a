"""What cleaning does to the depth of simulated sensors: noise, pixels far off, pixels measured.

``python -m docs.results.studies.depth_cleanup --root FOLDER --out docs/results/depth_cleanup.json``. Data sets
``SCENE_480`` in the folder are generated without a sensor at 480 x 640 pixels; its errors are added here, as measured
(in metres), from one seed. What the importer makes of them is compared with what it makes of true depth. *Error* is the
median distance from true depth as a share of it, *off* what differs by more than 3 %, as a share of all pixels.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.importers.image_geometry import ImageGeometry
from data_gen.importers.images import pixel_centers, sample_depth
from data_gen.importers.recording import Recording
from data_gen.importers.settings import load_import_settings
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.sensors import Sensor, load_sensor
from vpd_lightning.data.sensors.sensor import median_depth
from vpd_lightning.files import AtomicPath

SCENES = ("mujoco_block", "deformable_collision")
SENSORS = ("structured_light", "active_stereo", "time_of_flight")
FULL_SIZE = ("as measured", "flying_pixels=0.02", "smooth=2", "flying_pixels=0.02 smooth=2")
SMALL_SIZE = ("height=96", "height=96 flying_pixels=0.02 smooth=2", "height=96 flying_pixels=0.02 smooth=4")
MIDDLE = "height=96, depth of the middle"  # as imports were before
FAR_OFF = 0.03
FRAMES = (0, 12)


def measure(path: Path, sensor_name: str, frames: Sequence[int]) -> dict[str, dict[str, float]]:
    """Return the figures of one trajectory, all its views together, by what was cleaned."""
    settings = load_sensor(sensor_name)
    assert settings is not None
    with TrajectoryReader(path) as reader:
        views = range(reader.num_views)
        true = reader.depth(list(frames), views)
        intrinsics, poses = reader.cameras([0], views)
        sensor = Sensor(settings, seed=0, trajectory=path.stem, median_depth=median_depth(true[0], reader.far))
    seen = np.stack(
        [
            [sensor.measure_depth(true[i, v], intrinsics[0, v], frame, v) for v in views]
            for i, frame in enumerate(frames)
        ]
    )

    def geometry(depth: np.ndarray, words: str) -> ImageGeometry:
        height, width = depth.shape[2:]
        changes = {key: float(value) for key, value in (word.split("=") for word in words.split() if "=" in word)}
        if "height" in changes:
            changes["height"] = int(changes["height"])
        recording = Recording(
            "r", height, width, intrinsics[0], poses[0], len(depth), len(views), 0.1,
            lambda time, view: np.zeros((height, width, 3), np.uint8), lambda time, view: depth[time, view],
        )  # fmt: skip
        return ImageGeometry(recording, load_import_settings(changes))

    found = {}
    for words in (*FULL_SIZE, *SMALL_SIZE, MIDDLE):
        kept = "height=96" if "height" in words else ""
        started = time.process_time()
        made = geometry(seen, "" if words in (FULL_SIZE[0], MIDDLE) else words)
        pictures = np.stack([[made.depth(time, view) for view in views] for time in range(len(frames))])
        seconds = (time.process_time() - started) / (len(frames) * len(views))
        exact = geometry(true, kept)
        expected = np.stack([[exact.depth(time, view) for view in views] for time in range(len(frames))])
        if words == MIDDLE:
            places = np.meshgrid(
                pixel_centers(96, seen.shape[2]), pixel_centers(exact.width, seen.shape[3]), indexing="ij"
            )
            pictures = np.stack([[sample_depth(one, *places) for one in row] for row in seen])
        both = (pictures > 0) & (expected > 0)
        error = np.abs(pictures[both] - expected[both]) / expected[both]
        found[words] = {
            "error_percent": float(100 * np.median(error)),
            "off_percent": float(100 * (error > FAR_OFF).sum() / pictures.size),
            "measured_percent": float(100 * (pictures > 0).mean()),
        } | ({} if words == MIDDLE else {"cpu_milliseconds": 1000 * seconds})
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure all data sets that are there and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    cells: dict[str, Any] = {}
    for scene in SCENES:
        folder = options.root / f"{scene}_480"
        if not folder.exists():
            print(f"{folder} is not there: left out")
            continue
        path = load_manifest(folder).splits["test"][0]
        for sensor in SENSORS:
            cells[f"{scene}/{sensor}"] = measure(path, sensor, FRAMES)
            print(scene, sensor, json.dumps(cells[f"{scene}/{sensor}"], indent=1))
    with AtomicPath(options.out) as part:
        result = {"command": "python -m docs.results.studies.depth_cleanup", "frames": list(FRAMES), "cells": cells}
        part.write_text(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
