"""Precision and recall of what may move, by sensor, noise and picture size.

``python -m docs.results.studies.what_may_move --root FOLDER --out runs/what_may_move.json``. Data sets ``SCENE_SIZE``
in the folder are generated without a sensor (those that are not there are left out); its errors are added here, from
one seed. All measured pixels in the
workspace are judged against the true segmentation, all views and frames of a cell together: flying pixels and holes
count as they are. ``--plain`` measures the way that takes depth for true, whatever the noise. ``--join before=FILE,...
after=FILE,...`` puts what was measured into one file, with the worst of all scenes for each size, sensor and noise.
"""

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vpd_lightning.config import build_simulator, compose
from vpd_lightning.data.clip import read_cameras
from vpd_lightning.data.ground_truth import read_state
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.sensors import Sensor, load_sensor
from vpd_lightning.data.sensors.sensor import median_depth
from vpd_lightning.encoder.particles.unprojection import UnprojectingEncoder
from vpd_lightning.types import RGBDFrames

SCENES = (
    "mujoco_block", "deformable_block", "deformable_multi", "deformable_collision", "movi_a", "movi_b", "movi_c",
)  # fmt: skip
SENSORS = ("structured_light", "active_stereo")
PERCENTS = (0.0, 0.2, 0.35, 0.5, 0.9)


def noisy_frames(path: Path, times: Sequence[int], sensor: str, percent: float) -> tuple[RGBDFrames, torch.Tensor]:
    """Return frames (axes time, view) as the sensor sees them, and which pixels show a body."""
    with TrajectoryReader(path) as reader:
        views = range(reader.num_views)
        rgb, depth = torch.from_numpy(reader.rgb(times, views)), reader.depth(times, views)
        cameras, far = read_cameras(reader, times, views), reader.far
    if percent > 0:
        settings = load_sensor(sensor, {"percent_at_median": percent})
        assert settings is not None
        errors = Sensor(settings, seed=0, trajectory=path.stem, median_depth=median_depth(depth[0], far))
        intrinsics = cameras.intrinsics.double().numpy()
        for number, time_step in enumerate(times):
            for view in views:
                depth[number, view] = errors.measure_depth(
                    depth[number, view], intrinsics[number, view], time_step, view
                )
    frames = RGBDFrames(rgb.float() / 255, torch.from_numpy(depth), cameras)
    return frames, torch.from_numpy(read_state(path).segmentation[list(times)] > 0)


@torch.no_grad()
def measure_cell(
    folder: Path, encoder: UnprojectingEncoder, sensor: str, percent: float, times: Sequence[int]
) -> dict[str, Any]:
    """Return precision, recall, the counts behind them, and the seconds of one frame of all views."""
    hit = said = true = 0
    seconds = []
    for path in load_manifest(folder).split("test"):
        frames, body = noisy_frames(path, times, sensor, percent)
        start = time.process_time()
        found, candidates = encoder.moving_pixels(frames)
        seconds.append((time.process_time() - start) / len(times))
        body = body & candidates
        hit, said, true = hit + int((found & body).sum()), said + int(found.sum()), true + int(body.sum())
    return {
        "precision": hit / max(said, 1), "recall": hit / max(true, 1), "found": said, "true": true,
        "cpu_seconds_per_frame": float(np.median(seconds)),
    }  # fmt: skip


def measure(
    root: Path,
    scenes: Sequence[str],
    sizes: Sequence[int],
    times: Sequence[int],
    percents: Sequence[float],
    is_plain: bool,
) -> dict[str, Any]:
    """Return one entry for each scene, size, sensor and percentage of noise at the median depth."""
    cells: dict[str, Any] = {}
    for scene in scenes:
        words = ["run.folder=unused", f"experiment={scene}", "model=inertial", "size=small"]
        encoder = build_simulator(compose("train", words)).encoder
        assert isinstance(encoder, UnprojectingEncoder) and encoder.background is not None
        if is_plain:
            encoder.background.noise_floor = None
        for size in sizes:
            if not (root / f"{scene}_{size}").is_dir():
                print(f"{scene}_{size} is not there: left out")
                continue
            for sensor in SENSORS:
                for percent in percents:
                    name = f"{scene}/{size}/{sensor}/{percent:g}"
                    cells[name] = measure_cell(root / f"{scene}_{size}", encoder, sensor, percent, times)
                    print(name, {key: round(value, 3) for key, value in cells[name].items()}, flush=True)
    return {"times": list(times), "split": "test", "cells": cells}


def worst(cells: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the lowest precision and recall of all scenes, by ``SIZE/SENSOR/PERCENT``."""
    groups: dict[str, dict[str, Any]] = {}
    for name, cell in cells.items():
        group = groups.setdefault(name.partition("/")[2], {"precision": 1.0, "recall": 1.0, "scenes": 0})
        group["scenes"] += 1
        for score in ("precision", "recall"):
            group[score] = min(group[score], cell[score])
    return groups


def joined(words: Sequence[str]) -> dict[str, Any]:
    """Return what was measured in several runs: ``NAME=FILE,FILE`` puts the cells of the files under a name."""
    result: dict[str, Any] = {"worst": {}}
    for word in words:
        name, _, files = word.partition("=")
        found = [json.loads(Path(file).read_text()) for file in files.split(",")]
        result |= {"times": found[0]["times"], "split": found[0]["split"]}
        result[name] = {cell: values for one in found for cell, values in one["cells"].items()}
        result["worst"][name] = worst(result[name])
    return result


def main() -> None:
    """Measure from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, default=Path("datasets"), help="folder of the data sets SCENE_SIZE")
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--sizes", nargs="+", type=int, default=[64, 128])
    parser.add_argument("--times", nargs="+", type=int, default=[0, 10, 20], help="frames")
    parser.add_argument("--percents", nargs="+", type=float, default=PERCENTS, help="noise at the median depth")
    parser.add_argument("--plain", action="store_true", help="take depth for true")
    parser.add_argument("--out", type=Path, default=Path("runs/what_may_move.json"))
    parser.add_argument("--join", nargs="+", metavar="NAME=FILE,...", help="measure nothing, but join these")
    given = parser.parse_args()
    torch.set_num_threads(1)
    measured = (given.root, given.scenes, given.sizes, given.times, given.percents, given.plain)
    result = joined(given.join) if given.join else measure(*measured)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
