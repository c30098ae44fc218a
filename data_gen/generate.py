"""Make a data set: every trajectory its own atomic file, on all cores, resumable, the manifest last.

From a script, call ``generate`` under ``if __name__ == "__main__":`` (workers are spawned and import the script again).
"""

import json
import os
import platform
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from data_gen import worker
from data_gen.pool import run_jobs
from data_gen.progress import Progress
from data_gen.settings import differences, load_settings, require_choice, scene_names, settings_hash
from vpd_lightning.data.manifest import FILE_NAME, Manifest, file_sha256, load_manifest, write_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.schema import PARTIAL_SUFFIX, AtomicPath
from vpd_lightning.errors import ConfigError, DataError

PLAN_FILE = ".generation.json"  # what an unfinished data set was asked to be
LICENSE = "Apache-2.0"
_RAW_BYTES_PER_PIXEL = 8  # uint8 RGB, float32 depth, uint8 segmentation
_COMPRESSION_RATIO = 0.35  # measured 0.16 at 128x128, 0.2 at 64x64; the rest is reserve
_DISK_RESERVE = 64 * 2**20


@dataclass(frozen=True)
class Plan:
    """What to make, where."""

    scene: str
    preset: str
    seed: int
    out: Path
    settings: Any
    scene_version: int

    @property
    def scene_hash(self) -> str:
        """Changes with anything that changes the data; stands in each file."""
        return settings_hash(_identity(self))

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
) -> Path:
    """Generate a data set and return its folder; complete files of an interrupted run are kept.

    Args:
        scene: folder in ``conf/data_gen``, for example ``mujoco_block``.
        preset: file in that folder: ``paper``, ``demo`` or ``tiny``.
        out: folder to write; made if missing.
        seed: the same seed gives the same physics anywhere, and the same bytes on one machine.
        renderer: ``auto`` (EGL, then OSMesa), ``egl``, ``osmesa`` or ``raycast``; ``None`` takes the preset's.
        workers: processes; ``None`` takes all cores this process may use. It never changes the data.
        overrides: settings by (dotted) name, for example ``{"splits.train": 8}``.

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
    plan = make_plan(scene, preset, Path(out).expanduser().absolute(), seed, changes)
    if _is_complete(plan):
        print(f"{plan.out} is complete already.")
        return plan.out
    _refuse_other_unfinished(plan)
    files = plan.files()
    done = {path for paths in files.values() for path in paths if _is_done(path, plan.scene_hash)}
    missing = {
        (split, index): path for split, paths in files.items() for index, path in enumerate(paths) if path not in done
    }
    _check_disk(plan, len(missing))
    backend = _choose_backend(plan.settings.renderer) if missing else plan.settings.renderer
    with _claim_folder(plan):
        return _fill(plan, files, done, missing, backend, workers)


def _fill(
    plan: Plan,
    files: dict[str, list[Path]],
    done: set[Path],
    missing: Mapping[tuple[str, int], Path],
    backend: str,
    workers: int | None,
) -> Path:
    num_workers = min(workers or _num_cores(), max(len(missing), 1))
    with Progress(f"{plan.scene} {plan.preset}", len(done) + len(missing), len(done)) as progress:
        hashes = _make(plan, missing, backend, num_workers, progress.advance)
    hashes.update({path: file_sha256(path) for path in done})
    _write_manifest(plan, files, hashes, backend)
    (plan.out / PLAN_FILE).unlink(missing_ok=True)
    size = sum(path.stat().st_size for path in hashes)
    print(f"{plan.out}: {len(hashes)} trajectories, {size / 2**20:.1f} MiB, renderer {backend}")
    return plan.out


def make_plan(scene: str, preset: str, out: Path, seed: int, overrides: Mapping[str, Any]) -> Plan:
    """Check all settings and return what would be made."""
    require_choice("scene", scene, scene_names())
    module = import_module(f"data_gen.{scene}")
    settings = load_settings(module.Settings, scene, preset, overrides)
    return Plan(scene, preset, seed, out, settings, module.VERSION)


def _make(
    plan: Plan,
    missing: Mapping[tuple[str, int], Path],
    backend: str,
    num_workers: int,
    advance: Callable[[], None],
) -> dict[Path, str]:
    """Make the missing files and return their SHA-256; in this process where one worker and no GL are enough."""
    hashes: dict[Path, str] = {}
    if num_workers == 1 and backend == "raycast":
        worker.start(plan.scene, plan.settings, backend, None)
        try:
            for (split, index), path in missing.items():
                hashes[path] = worker.make_file(plan.seed, split, index, path, plan.scene_hash)
                advance()
        finally:
            worker.stop()
        return hashes
    jobs = {path: (plan.seed, split, index, path, plan.scene_hash) for (split, index), path in missing.items()}
    arguments = (plan.scene, plan.settings, backend)
    return run_jobs(jobs, arguments, worker.environment(backend), num_workers, advance)


def _choose_backend(renderer: str) -> str:
    if renderer == "raycast":
        return renderer
    from data_gen.gl_backend import choose_backend

    return choose_backend(renderer)


def _num_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _is_complete(plan: Plan) -> bool:
    """Tell whether the data set is finished; refuse one that was made from other settings."""
    if not (plan.out / FILE_NAME).exists():
        return False
    manifest = load_manifest(plan.out)
    found = {"scene": manifest.scene, "seed": manifest.seed, **manifest.settings}
    _refuse_other(plan, found, "holds a finished data set")
    return True


def _refuse_other_unfinished(plan: Plan) -> None:
    """Refuse a folder that was begun with other settings (unless nothing is in it yet) or holds strange files."""
    if plan.out.exists() and not plan.out.is_dir():
        raise DataError(f"{plan.out} is a file. Choose another out=FOLDER.")
    present = sorted(plan.out.glob("*/*.h5"))
    if not present:
        return
    path = plan.out / PLAN_FILE
    if path.exists():
        try:
            found = json.loads(path.read_text())
        except ValueError as error:
            raise DataError(f"{path} is damaged. Delete {plan.out}, or choose another out=FOLDER.") from error
        _refuse_other(plan, found, "holds an unfinished data set")
        return
    strangers = [path for path in present if not _is_done(path, plan.scene_hash)]
    if strangers:
        raise DataError(
            f"{plan.out} holds files that are not from this run, for example {strangers[0].relative_to(plan.out)}.\n"
            "Choose another out=FOLDER, or delete that folder."
        )


@contextmanager
def _claim_folder(plan: Plan) -> Iterator[None]:
    """Make the folder, keep other generators out of it, and note what it is to become."""
    try:
        for split in plan.files():
            (plan.out / split).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{plan.out} cannot be written: {error.strerror}. Choose another out=FOLDER.") from error
    handle = os.open(plan.out, os.O_RDONLY)
    try:
        _lock(plan.out, handle)
        for left_over in plan.out.glob(f"**/.*{PARTIAL_SUFFIX}"):  # of a killed process
            left_over.unlink(missing_ok=True)
        with AtomicPath(plan.out / PLAN_FILE) as partial:
            partial.write_text(json.dumps(_identity(plan), indent=1) + "\n")
        yield
    finally:
        os.close(handle)


def _lock(folder: Path, handle: int) -> None:
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise DataError(f"Another vpd-data is writing {folder}. Wait for it, or choose another out=FOLDER.") from error
    except OSError:  # a file system without locks
        return


def _identity(plan: Plan) -> dict[str, Any]:
    return {"scene": plan.scene, "seed": plan.seed, **_recipe(plan)}


def _recipe(plan: Plan) -> dict[str, Any]:
    """All settings, and the version of the scene's code: another version may draw other pictures from them."""
    return {"scene_version": plan.scene_version, **asdict(plan.settings)}


def _refuse_other(plan: Plan, found: Mapping[str, Any], what: str) -> None:
    different = differences(_identity(plan), found)
    if different:
        raise DataError(
            f"{plan.out} {what} made from other settings; it is left as it is.\n"
            f"Asked for {'; '.join(different[:3])}{'; ...' if len(different) > 3 else ''}.\n"
            f"Choose another out=FOLDER, or delete that folder first (rm -r {plan.out})."
        )


def _is_done(path: Path, scene_hash: str) -> bool:
    """Tell whether a file is there, opens, and was made from these settings (its data are not read)."""
    if not path.exists():
        return False
    try:
        with TrajectoryReader(path) as reader:
            return reader.scene_hash == scene_hash
    except DataError:
        return False


def _check_disk(plan: Plan, num_missing: int) -> None:
    camera = plan.settings.camera
    pixels = plan.settings.num_frames * camera.num_views * camera.height * camera.width * num_missing
    ratio = 1.0 if plan.settings.storage.compression == "none" else _COMPRESSION_RATIO
    needed = int(pixels * _RAW_BYTES_PER_PIXEL * ratio) + _DISK_RESERVE
    existing = next(folder for folder in (plan.out, *plan.out.parents) if folder.exists())
    free = shutil.disk_usage(existing).free
    if free < needed:
        raise DataError(
            f"The disk of {plan.out} has {free / 2**30:.2f} GiB free; {num_missing} trajectories need about "
            f"{needed / 2**30:.2f} GiB.\nFree some space, choose another out=FOLDER, or ask for fewer (splits.train=N)."
        )


def _write_manifest(plan: Plan, files: dict[str, list[Path]], hashes: Mapping[Path, str], backend: str) -> None:
    names = {path: path.relative_to(plan.out).as_posix() for path in hashes}
    write_manifest(
        Manifest(
            folder=plan.out,
            name=plan.out.name,
            scene=plan.scene,
            preset=plan.preset,
            seed=plan.seed,
            splits=files,
            sha256={names[path]: value for path, value in hashes.items()},
            num_bytes={names[path]: path.stat().st_size for path in hashes},
            settings=_recipe(plan),
            generator=f"vpd-data generate, renderer {backend}",
            versions=_versions(),
            license=LICENSE,
        )
    )


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in ("mujoco", "numpy", "h5py", "vpd-lightning"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found
