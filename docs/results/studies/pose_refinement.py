"""How well ``refine_poses`` finds the places of misplaced cameras again, with simulated sensors.

``python -m docs.results.studies.pose_refinement --root FOLDER --out docs/results/pose_refinement.json``. Data sets
``SCENE_240`` in the folder are generated without a sensor, at 240 x 320 pixels. The first four cameras are taken; all
but the first are shifted and turned by ``SHIFT`` and ``TURN`` (standard deviations along and about each axis), and the
errors of a sensor are added to their depth. Figures say by how much a camera's points lie off, root mean square, in
percent of the scene's median depth: the median over cameras, and the worst. ``nearest`` is ICP by nearest points
(``small_gicp``, generalised ICP), each camera against the first; it is measured with ``--nearest``, where that is
installed.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_gen.importers.image_geometry import ImageGeometry
from data_gen.importers.pose_refinement import refine_poses
from data_gen.importers.recording import Recording
from data_gen.importers.settings import ImportSettings
from data_gen.inspection.posed_depth import Array, PosedDepth
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.sensors import Sensor, load_sensor
from vpd_lightning.data.sensors.sensor import median_depth
from vpd_lightning.errors import DataError
from vpd_lightning.files import AtomicPath

SCENES = ("mujoco_block", "movi_a")
SENSORS = ("none", "structured_light", "active_stereo")
NUM_VIEWS, NUM_FRAMES = 4, 7
SHIFT, TURN = 0.005, 0.3  # share of the median depth, degrees


def measure(paths: Sequence[Path], sensor_name: str, with_nearest: bool) -> dict[str, Any]:
    """Return the errors of all misplaced cameras of some trajectories, before and after."""
    found: dict[str, list[float]] = {}
    num_refused = 0
    for index, path in enumerate(paths):
        with TrajectoryReader(path) as reader:
            views = range(min(NUM_VIEWS, reader.num_views))
            times = np.linspace(0, reader.num_frames - 1, NUM_FRAMES).round().astype(int).tolist()
            true_depth, far = reader.depth(times, views), reader.far
            intrinsics, poses = (part[0] for part in reader.cameras([0], views))
        depth = median_depth(true_depth[0], far)
        settings = load_sensor(sensor_name)
        seen = true_depth
        if settings is not None:
            sensor = Sensor(settings, seed=0, trajectory=path.stem, median_depth=depth)
            images = [
                [sensor.measure_depth(true_depth[i, v], intrinsics[v], time, v) for v in views]
                for i, time in enumerate(times)
            ]
            seen = np.array(images)
        rng = np.random.default_rng(index)
        given = poses.copy()
        given[1:, :3, 3] += rng.normal(0, SHIFT * depth, (len(views) - 1, 3))
        turns = Rotation.from_rotvec(np.radians(rng.normal(0, TURN, (len(views) - 1, 3)))).as_matrix()
        given[1:, :3, :3] = turns @ given[1:, :3, :3]
        started = time.process_time()
        try:
            refined = _refined(seen, intrinsics, given)
        except DataError:  # too far from what was given
            num_refused += 1
            refined = given
        found.setdefault("seconds", []).append(time.process_time() - started)
        nearest = _nearest(seen, intrinsics, given) if with_nearest else None
        for name, each in {"given": given, "refined": refined, "nearest": nearest}.items():
            if each is None:
                continue
            off = [_misplaced(true_depth[0, v], intrinsics[v], each[v], poses[v], 2 * depth) for v in views[1:]]
            found.setdefault(f"{name}_percent", []).extend(100 * np.array(off) / depth)
    return {name: float(np.median(values)) for name, values in found.items()} | {
        "worst_percent": float(np.max(found["refined_percent"])),
        "worst_given_percent": float(np.max(found["given_percent"])),
        "num_cameras": len(found["given_percent"]),
        "num_refused": num_refused,  # trajectories whose poses stay as they were, with an error
    }


def _misplaced(depth: NDArray[np.float32], intrinsics: Array, pose: Array, true: Array, far: float) -> float:
    """Return by how much a pose puts the points of an image in the wrong place: root mean square, metres."""
    near = np.where(depth <= far, depth, np.float32(0))
    offsets = PosedDepth(near, intrinsics, pose).points() - PosedDepth(near, intrinsics, true).points()
    return float(np.sqrt((offsets**2).sum(axis=1).mean()))


def _refined(seen: NDArray[np.floating[Any]], intrinsics: Array, given: Array) -> Array:
    height, width = seen.shape[2:]
    recording = Recording(
        "r", height, width, intrinsics, given, len(seen), len(given), 0.1,
        lambda time, view: np.zeros((height, width, 3), np.uint8), lambda time, view: seen[time, view],
    )  # fmt: skip
    return refine_poses({"r": ImageGeometry(recording, ImportSettings())}, 1).poses["r"]


def _nearest(seen: NDArray[np.floating[Any]], intrinsics: Array, given: Array) -> Array | None:
    try:
        import small_gicp
    except ImportError:
        return None
    still = np.median(seen, axis=0)
    points = [PosedDepth(still[v], intrinsics[v], given[v]).points() for v in range(len(given))]
    depth = float(np.median(still[still > 0]))
    first, tree = small_gicp.preprocess_points(points[0], 0.008 * depth, num_neighbors=20)
    poses = given.copy()
    for view in range(1, len(given)):
        cloud, _ = small_gicp.preprocess_points(points[view], 0.008 * depth, num_neighbors=20)
        for reach in (0.06, 0.03, 0.015):
            start = poses[view] @ np.linalg.inv(given[view])
            result = small_gicp.align(
                first, cloud, tree, init_T_target_source=start, max_correspondence_distance=reach * depth,
                max_iterations=50, rotation_epsilon=1e-6, translation_epsilon=1e-6,
            )  # fmt: skip
            poses[view] = result.T_target_source @ given[view]
    return poses


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure all data sets that are there and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--nearest", action="store_true", help="measure nearest points, too; takes minutes a cell")
    options = parser.parse_args(arguments)
    cells: dict[str, Any] = {}
    for scene in SCENES:
        folder = options.root / f"{scene}_240"
        if not folder.exists():
            print(f"{folder} is not there: left out")
            continue
        for sensor in SENSORS:
            cells[f"{scene}/{sensor}"] = measure(load_manifest(folder).splits["test"], sensor, options.nearest)
            print(scene, sensor, json.dumps(cells[f"{scene}/{sensor}"]))
    with AtomicPath(options.out) as part:
        result = {"command": "python -m docs.results.studies.pose_refinement", "cells": cells}
        part.write_text(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
