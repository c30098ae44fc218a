"""Data: reading windows of frames, what a training waits for its loader, and making trajectories stage by stage."""

import contextlib
import functools
import io
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks import plots
from benchmarks.measuring import Options, Result, Row, interleaved, row
from data_gen.settings import preset_names, require_choice, scene_names
from vpd_lightning.data import schema
from vpd_lightning.data.datamodule import VideoDataModule
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.reader import TrajectoryReader

CPU = torch.device("cpu")
WINDOW = 8  # frames
STORAGES = {
    "gzip": {"compression": "gzip", "depth_encoding": "float32"},
    "gzip, 16-bit depth": {"compression": "gzip", "depth_encoding": "uint16"},
    "uncompressed": {"compression": "none", "depth_encoding": "float32"},
}
LOADERS = [(workers, cache) for workers in (0, 2) for cache in (True, False)]
Window = tuple[NDArray[np.uint8], NDArray[np.float32]]


def run(options: Options) -> Result:
    """Measure reading, loading and generating; everything is made in a temporary folder.

    Raises:
        ConfigError: some data set has no such preset.
    """
    for scene in scene_names():
        require_choice("preset", options.preset, preset_names(scene))
    with TemporaryDirectory() as name:
        folder = Path(name)
        rows = reading(folder, options)
        more, facts = loading(folder, options)
        made, generated = generating(folder, options)
    return Result([*rows, *more, *made], {**facts, **generated})


def reading(folder: Path, options: Options) -> list[Row]:
    """Read windows of 8 frames and all views from open files; nothing of them is unpacked yet, all pages in memory."""
    size, count = options.pick(128, 128, 16), options.pick(60, 21, 3)
    small = {"splits.train": 1, "splits.validation": 0, "splits.test": 0, "camera.height": size, "camera.width": size}
    rows = []
    for storage, choice in STORAGES.items():
        changes = {f"storage.{key}": value for key, value in choice.items()}
        made = _generate("mujoco_block", "demo", folder / storage, {**small, **changes})
        original = load_manifest(made).split("train")[0]
        with contextlib.ExitStack() as stack:
            readers, files = [], []
            for copy in range(count // 3 + 1):  # each image is read once: three windows each, and one to warm up
                ours, theirs = (shutil.copy(original, made / f"{copy} {kind}.h5") for kind in ("ours", "theirs"))
                readers.append(stack.enter_context(TrajectoryReader(ours)))
                files.append(stack.enter_context(h5py.File(theirs)))
            views = list(range(readers[0].num_views))
            turns = [(turn // 3, WINDOW * (turn % 3)) for turn in range(count + 1)]
            windows = {
                "read": (_window(readers[which], start, views) for which, start in turns),
                "image by image": (_image_by_image(files[which], start, views) for which, start in turns),
                "open and read": (_opened(original, start, views) for _, start in turns),
            }
            turn_by_turn = {name: functools.partial(next, each) for name, each in windows.items()}
            seconds = interleaved(turn_by_turn, count, CPU, clock=time.perf_counter)
            _require_equal(_window(readers[0], 3, views), _image_by_image(files[0], 3, views), storage)
        note = f"{WINDOW} frames x {len(views)} views of {size}x{size}, colour and depth; wall time, median of {count}"
        rows.append(row(f"read/{storage}", seconds["read"], "image by image", seconds["image by image"], note=note))
        if storage == "gzip":
            rows.append(row(f"open and read/{storage}", seconds["open and read"], note=note))
    return rows


def _window(reader: TrajectoryReader, start: int, views: list[int]) -> Window:
    times = range(start, start + WINDOW)
    return reader.rgb(times, views), reader.depth(times, views)


def _opened(path: Path, start: int, views: list[int]) -> Window:
    with TrajectoryReader(path) as reader:
        return _window(reader, start, views)


def _image_by_image(file: h5py.File, start: int, views: list[int]) -> Window:
    """What one writes first: a loop over frames and views."""
    times = range(start, start + WINDOW)
    rgb = np.stack([np.stack([file[schema.RGB][time, view] for view in views]) for time in times])
    depth = np.stack([np.stack([file[schema.DEPTH][time, view] for view in views]) for time in times])
    if depth.dtype == np.uint16:
        attributes = file[schema.DEPTH].attrs
        depth = schema.decode_depth(depth, float(attributes["scale"]), float(attributes["offset"]))
    return rgb, depth


def _require_equal(first: Window, second: Window, storage: str) -> None:
    if not all(np.array_equal(a, b) for a, b in zip(first, second, strict=True)):
        raise AssertionError(f"read/{storage}: the reader and the plain loop disagree")


def loading(folder: Path, options: Options) -> tuple[list[Row], dict[str, Any]]:
    """Train the demo for some steps; per step, the wall time spent waiting for the loader and that of the step."""
    trajectories, steps = options.pick(8, 8, 2), options.pick(24, 12, 2)
    warm_up = 2 * trajectories // 4 + 2  # steps until most files are open, or decoded and kept
    splits = {"splits.train": trajectories, "splits.validation": 0, "splits.test": 0}
    data = _generate("mujoco_block", "demo", folder / "demo", splits)
    rows, facts = [], {}
    for workers, cache in LOADERS:
        waits, works = _train(data, options, workers, cache, warm_up, steps)
        what = f"{workers} workers, {'cached' if cache else 'not cached'}"
        share = sum(waits) / (sum(waits) + sum(works))
        note = f"mean of {steps} demo steps of 4 clips; waits for {100 * share:.1f} % of the time"
        rows.append(row(f"wait/{what}", [mean(waits)], "training step", [mean(works)], note=note))
        facts[f"share of the time spent waiting, {what}"] = share
    return rows, facts


def _train(
    data: Path, options: Options, workers: int, cache: bool, warm_up: int, steps: int
) -> tuple[list[float], list[float]]:
    """Return the seconds of waiting and of working of every step after the warm-up."""
    from vpd_lightning.config import build, build_list, build_simulator, compose
    from vpd_lightning.losses.base import AbstractLoss
    from vpd_lightning.training.optimization import AbstractOptimization

    words = [f"data.folder='{data}'", f"data.num_workers={workers}", f"data.cache={str(cache).lower()}"]
    small = ["encoder.num_particles=64", "data.rays_per_step=16"] if options.size == "tiny" else []
    config = compose("train", ["experiment=demo", "run.folder=unused", "data.num_validation_clips=0", *words, *small])
    datamodule = build(config["data"], VideoDataModule, "data")
    torch.manual_seed(0)
    simulator = build_simulator(config)
    background = simulator.encoder.background
    if background is not None and background.needs_fit:
        background.fit(*datamodule.median_background())  # type: ignore[operator]
    simulator = simulator.to(options.device)
    losses = build_list(config["loss"], AbstractLoss, "loss")
    optimizer, _ = build(config["optimizer"], AbstractOptimization, "optimizer").build(simulator, warm_up + steps)
    waits, works = [], []
    batches = iter(datamodule.loader(max_steps=warm_up + steps))
    for _ in range(warm_up + steps):
        started = time.perf_counter()
        batch = next(batches)
        ready = time.perf_counter()
        batch = batch.to(options.device)
        output = simulator(batch)
        total = torch.stack([loss.weight * loss(output, batch) for loss in losses]).sum()
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        float(total.detach())  # a GPU is done only now
        waits.append(ready - started)
        works.append(time.perf_counter() - ready)
    return waits[warm_up:], works[warm_up:]


def generating(folder: Path, options: Options) -> tuple[list[Row], dict[str, Any]]:
    """Make one trajectory of every set in a process of its own; processor time of each stage."""
    rows: list[Row] = []
    facts: dict[str, Any] = {}
    for scene in options.pick(scene_names(), scene_names(), ["movi_a", "mujoco_block"]):
        item = _made(scene, options.preset, folder / f"one {scene}", options)
        if item is None:
            facts[scene] = "not made: it needs EGL or OSMesa"
            continue
        note = f"{item.num_views} views of {item.size}, {item.backend}; preset {options.preset}"
        rows += [row(f"make/{scene}/{stage}", [max(value, 1e-6)]) for stage, value in item.seconds.items()]
        whole = sum(item.seconds.values())
        rows.append(row(f"make/{scene}/whole", [whole], note=note))
        facts[f"views per CPU second, {scene}"] = item.num_views / whole
        facts[f"CPU minutes, {scene}"] = whole * item.num_trajectories / 60
    return rows, facts


@dataclass(frozen=True)
class _Made:
    """One trajectory: its CPU seconds by stage, its views and who drew them, and how many the whole set has."""

    seconds: dict[str, float]
    num_views: int
    size: str
    backend: str
    num_trajectories: int


def _made(scene: str, preset: str, out: Path, options: Options) -> _Made | None:
    """Make the first trajectory; None where the scene wants a GL renderer and none works here."""
    from data_gen import worker
    from data_gen.generate import make_plan
    from data_gen.gl_backend import working_backend
    from data_gen.pool import run_jobs

    changes = {"num_frames": 2, "camera.height": 16, "camera.width": 16} if options.size == "tiny" else {}
    plan = make_plan(scene, preset, out, 0, changes)
    backend = plan.settings.renderer
    if backend == "auto":
        found = working_backend()
        if found is None:
            return None
        backend = found
    path = out / "train" / "000000.h5"
    path.parent.mkdir(parents=True)
    jobs = {path: (0, "train", 0, path, "")}  # nobody asks these files what they were made from
    made = run_jobs(jobs, (plan.family, plan.settings, backend, None), worker.environment(backend), 1, lambda: None)
    camera, splits = plan.settings.camera, plan.settings.splits
    return _Made(
        seconds=made[path].seconds,
        num_views=plan.settings.num_frames * camera.num_views,
        size=f"{camera.height}x{camera.width}",
        backend=backend,
        num_trajectories=splits.train + splits.validation + splits.test,
    )


def _generate(scene: str, preset: str, out: Path, overrides: dict[str, Any]) -> Path:
    """Generate in this process, by ray casting, without a word."""
    from data_gen.generate import generate

    with _silence():
        return generate(scene, preset, out, seed=0, renderer="raycast", workers=1, overrides=overrides)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield


def draw(result: Result, path: Path) -> None:
    """Draw all times but those of single stages of making a trajectory."""
    rows = [item for item in result.rows if not item.name.startswith("make/") or item.name.endswith("/whole")]
    plots.bars(rows, "Reading, waiting for the loader, making a trajectory", path)
