"""Make a data set: every trajectory its own atomic file, on all cores, resumable, the manifest last.

From a script, call ``generate`` under ``if __name__ == "__main__":`` (workers are spawned and import the script again).
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from data_gen import worker
from data_gen.dataset_folder import DatasetFolder
from data_gen.pool import num_cores, run_jobs
from data_gen.progress import Progress
from data_gen.settings import load_preset, load_settings
from data_gen.shards import parse_shard
from data_gen.simulated_sensor import rendered_settings
from data_gen.stage_clock import STAGES
from vpd_lightning.data.manifest import file_sha256
from vpd_lightning.data.sensors import SensorSettings, load_sensor
from vpd_lightning.data.sensors.settings import NO_SENSOR
from vpd_lightning.errors import ConfigError

_PACKAGES = ("mujoco", "numpy", "h5py", "vpd-lightning")
LICENSE = "Apache-2.0"
_RAW_BYTES_PER_PIXEL = 8  # uint8 RGB, float32 depth, uint8 segmentation
_COMPRESSION_RATIO = 0.35  # measured 0.16 at 128x128, 0.2 at 64x64; the rest is reserve


@dataclass(frozen=True)
class Plan:
    """What to make, where."""

    scene: str
    family: str
    preset: str
    seed: int
    out: Path
    settings: Any
    scene_version: int
    sensor: SensorSettings | None = None

    @property
    def folder(self) -> DatasetFolder:
        """Where it goes, with everything that decides what the files hold.

        The version of the scene's code is part of it: another version may draw other pictures from the same settings.
        """
        recipe = {"scene_version": self.scene_version, **asdict(self.settings)}
        for group, name in self.settings.PLACES:
            recipe[group].pop(name)
        if self.sensor is not None:
            recipe["sensor"] = asdict(self.sensor)
        return DatasetFolder(self.out, {"scene": self.scene, "seed": self.seed, **recipe})

    def files(self) -> dict[str, list[Path]]:
        """Return the paths of all trajectories by split."""
        counts = asdict(self.settings.splits)
        return {split: [self.out / split / f"{i:06d}.h5" for i in range(count)] for split, count in counts.items()}


def generate(
    scene: str,
    preset: str,
    out: str | Path,
    seed: int,
    renderer: str | None = None,
    workers: int | None = None,
    overrides: Mapping[str, Any] | None = None,
    sensor: str = NO_SENSOR,
    shard: str | None = None,
) -> Path:
    """Generate a data set and return its folder; complete files of an interrupted run are kept.

    Args:
        scene: folder in ``conf/data_gen``, for example ``mujoco_block``.
        preset: file in that folder: ``paper``, ``demo`` or ``tiny``.
        out: folder to write; made if missing.
        seed: the same seed gives the same physics anywhere, and the same bytes on one machine.
        renderer: ``auto`` (EGL, then OSMesa), ``egl``, ``osmesa`` or ``raycast``; ``None`` takes the preset's.
        workers: processes; ``None`` takes all cores this process may use. It never changes the data.
        overrides: settings by (dotted) name, for example ``{"splits.train": 8}``; of the sensor: ``sensor.NAME``.
        sensor: file in ``conf/sensor``: what the cameras get wrong.
        shard: ``i/n`` makes the i-th of n parts, on one of several machines; whichever ends last finishes the set.

    Raises:
        ConfigError: unknown names or values out of range.
        DataError: ``out`` holds a data set made from other settings, or the disk is too small.
        RenderingBackendError: a GL renderer is wanted and none works here.
    """
    changes = dict(overrides or {})
    if renderer is not None:
        changes["renderer"] = renderer
    if workers is not None and workers < 1:
        raise ConfigError(f"workers is {workers}; at least 1 is needed.")
    if not 0 <= seed < 2**63:
        raise ConfigError(f"seed is {seed}; allowed: 0 to 2^63 - 1.")
    part = parse_shard(shard)
    plan = make_plan(scene, preset, Path(out).expanduser().absolute(), seed, changes, sensor)
    folder, files = plan.folder, plan.files()
    if folder.is_complete():
        print(f"{plan.out} is complete already.")
        return plan.out
    wanted = part.of({(split, index): path for split, paths in files.items() for index, path in enumerate(paths)})
    everything = [path for paths in files.values() for path in paths]
    done = folder.done(everything) & set(wanted.values())
    missing = {key: path for key, path in wanted.items() if path not in done}
    folder.require_space(_num_bytes(plan, len(missing)), len(missing), "ask for fewer (splits.train=N)")
    backend = _choose_backend(plan.settings.renderer) if missing else plan.settings.renderer

    def finish(hashes: Mapping[Path, str]) -> None:
        generator = f"vpd-data generate, renderer {backend}"
        folder.finish(files, hashes, generator=generator, packages=_PACKAGES, preset=plan.preset, license=LICENSE)
        size = sum(path.stat().st_size for path in hashes)
        print(f"{plan.out}: {len(hashes)} trajectories, {size / 2**20:.1f} MiB, renderer {backend}")

    with folder.claim(part):
        made, speed = _fill(plan, folder, done, missing, backend, workers)
        if part.is_whole:
            finish({path: file.sha256 for path, file in made.items()} | {path: file_sha256(path) for path in done})
    if not part.is_whole:
        folder.finish_shard(part, everything, finish)
    if speed:
        print(speed)
    return plan.out


def _fill(
    plan: Plan,
    folder: DatasetFolder,
    done: set[Path],
    missing: Mapping[tuple[str, int], Path],
    backend: str,
    workers: int | None,
) -> tuple[dict[Path, worker.MadeFile], str]:
    """Make the missing files; return them, and how fast it went."""
    num_workers = min(workers or num_cores(), max(len(missing), 1))
    with Progress(f"{plan.scene} {plan.preset}", len(done) + len(missing), len(done)) as progress:
        started = time.monotonic()
        made = _make(plan, missing, backend, num_workers, folder.scene_hash, progress.advance)
        elapsed = time.monotonic() - started
    return made, _speed(plan, list(made.values()), elapsed, num_workers) if made else ""


def _speed(plan: Plan, made: Sequence[worker.MadeFile], elapsed: float, num_workers: int) -> str:
    """Say how fast it went: wall time over all workers, processor time per trajectory and stage."""
    stages = ", ".join(f"{name} {sum(file.seconds[name] for file in made) / len(made):.2f}" for name in STAGES)
    num_views = len(made) * plan.settings.num_frames * plan.settings.camera.num_views
    return (
        f"{num_views / elapsed:.0f} views/s with {num_workers} worker{'s' * (num_workers > 1)}; "
        f"CPU seconds per trajectory: {stages}"
    )


def make_plan(
    scene: str, preset: str, out: Path, seed: int, overrides: Mapping[str, Any], sensor: str = NO_SENSOR
) -> Plan:
    """Check all settings and return what would be made; ``overrides`` may hold settings of the sensor, too."""
    prefix = "sensor."
    changes = {key.removeprefix(prefix): value for key, value in overrides.items() if key.startswith(prefix)}
    overrides = {key: value for key, value in overrides.items() if not key.startswith(prefix)}
    errors = load_sensor(sensor, changes)
    family, _ = load_preset(scene, preset)
    module = import_module(f"data_gen.{family}")
    settings = load_settings(module.Settings, scene, preset, overrides)
    if errors is not None:
        rendered_settings(settings, errors)  # fails here once rather than in each worker
    return Plan(scene, family, preset, seed, out, settings, module.VERSION, errors)


def _make(
    plan: Plan,
    missing: Mapping[tuple[str, int], Path],
    backend: str,
    num_workers: int,
    scene_hash: str,
    advance: Callable[[], None],
) -> dict[Path, worker.MadeFile]:
    """Make the missing files and say what is known of them; in this process where one worker and no GL are enough."""
    made: dict[Path, worker.MadeFile] = {}
    if num_workers == 1 and backend == "raycast":
        worker.start(plan.family, plan.settings, backend, plan.sensor, None)
        try:
            for (split, index), path in missing.items():
                made[path] = worker.make_file(plan.seed, split, index, path, scene_hash)
                advance()
        finally:
            worker.stop()
        return made
    jobs = {path: (plan.seed, split, index, path, scene_hash) for (split, index), path in missing.items()}
    arguments = (plan.family, plan.settings, backend, plan.sensor)
    return run_jobs(jobs, arguments, worker.environment(backend), num_workers, advance)


def _choose_backend(renderer: str) -> str:
    if renderer == "raycast":
        return renderer
    if renderer == "blender":
        from data_gen.blender.process import find_python

        find_python()  # fails here once rather than in each worker
        return renderer
    from data_gen.gl_backend import choose_backend

    return choose_backend(renderer)


def _num_bytes(plan: Plan, num_missing: int) -> int:
    camera = plan.settings.camera
    pixels = plan.settings.num_frames * camera.num_views * camera.height * camera.width * num_missing
    ratio = 1.0 if plan.settings.storage.compression == "none" else _COMPRESSION_RATIO
    return int(pixels * _RAW_BYTES_PER_PIXEL * ratio)
