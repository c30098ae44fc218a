"""``vpd-data import``: other people's recordings to our files, resumable, atomic, the manifest last.

From a script, call ``import_recordings`` under ``if __name__ == "__main__":`` (workers are spawned and import the
script again).
"""

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from data_gen.dataset_folder import DatasetFolder
from data_gen.importers.clip_scene import ImportJob
from data_gen.importers.clips import Clip
from data_gen.importers.import_plan import ImportPlan, clip_trajectory, make_plan
from data_gen.importers.settings import load_import_settings
from data_gen.pool import num_cores, run_jobs
from data_gen.progress import Progress
from data_gen.shards import parse_shard
from data_gen.worker import environment
from vpd_lightning.data.manifest import SPLITS, file_sha256
from vpd_lightning.data.schema import write_trajectory
from vpd_lightning.errors import ConfigError, DataError

VERSION = 3  # of what the importers make from the same source and settings
_PACKAGES = ("numpy", "h5py", "opencv-python-headless", "vpd-lightning")
_MAPPED = ("ros", "lerobot", "tum")
SCENE = "recordings"  # the manifest's scene
_BYTES_PER_PIXEL = 7  # uint8 RGB, float32 depth
_SAID = ("estimated", "ground")  # of the bounds: how they were found
_NOT_IN_FILES = ("format", "mapping", "workers")  # they decide nothing beyond what stands elsewhere in the identity
_WORTH_WORKERS = 512 * 2**20  # bytes of images, below which starting processes takes longer than they save
_ENCODER_STEP = 16  # sides that the paper's encoder can halve and double again
_COMPRESSION_RATIO = 0.9  # of real pictures, at worst


def import_recordings(
    source: str | Path, out: str | Path, overrides: Mapping[str, Any] | None = None, shard: str | None = None
) -> Path:
    """Convert a source into a data set and return its folder; complete files of an interrupted import are kept.

    Args:
        source: folder or file; see ``formats.FORMATS``.
        out: folder to write; made if missing, and left alone if it holds something else.
        overrides: settings by (dotted) name; see ``settings.ImportSettings``.
        shard: ``i/n`` makes the i-th of n parts, on one of several machines; whichever ends last finishes the set.

    Raises:
        ConfigError: unknown settings, or values out of range or of the wrong type.
        DataError: the source is broken or contradicts itself, ``out`` holds something else, or the disk is too small.
    """
    settings, part = load_import_settings(overrides or {}), parse_shard(shard)
    path = Path(source).expanduser().absolute()
    folder_path = Path(out).expanduser().absolute()
    if folder_path == path or path.is_dir() and folder_path in path.parents:
        raise DataError(f"out={folder_path} holds the source itself. Choose another out=FOLDER.")
    if settings.mapping is not None:
        settings.mapping = str(Path(settings.mapping).expanduser())
        if not Path(settings.mapping).is_file():
            raise ConfigError(f"mapping={settings.mapping} is not a file; docs/your_data.md shows what it holds.")
    plan = make_plan(path, settings)
    if settings.mapping is not None and plan.format not in _MAPPED:
        raise ConfigError(f"{path} is of format {plan.format}, which takes no mapping ({', '.join(_MAPPED)} do).")
    folder = DatasetFolder(folder_path, _identity(plan))
    if folder.is_complete():
        print(f"{folder_path} is complete already.")
        return folder_path
    paths = [folder_path / clip.path for clip in plan.clips]
    wanted = part.of(dict(zip(paths, plan.clips, strict=True)))
    done = folder.done(paths) & wanted.keys()
    missing = {path: clip for path, clip in wanted.items() if path not in done}
    needed = sum(_num_bytes(plan, clip) for clip in missing.values())
    folder.require_space(needed, len(missing), "import less: height=, every=, max_recordings=")
    _workers_that_fit(plan)
    print(_description(plan))

    def finish(hashes: Mapping[Path, str]) -> None:
        splits, generator = _splits(plan, folder_path), f"vpd-data import, format {plan.format}"
        folder.finish(splits, hashes, generator=generator, packages=_PACKAGES)
        size = sum(path.stat().st_size for path in hashes)
        print(
            f"{folder_path}: {_counted(len(hashes), 'trajectory')}, {size / 2**20:.1f} MiB. "
            f"Check it: vpd-data validate {folder_path}"
        )

    with folder.claim(part):
        with Progress(f"import {path.name}", len(wanted), len(done)) as progress:
            hashes = _make(plan, missing, folder.scene_hash, progress.advance)
        if part.is_whole:
            finish(hashes | {path: file_sha256(path) for path in done})
    if not part.is_whole:
        folder.finish_shard(part, paths, finish)
    return folder_path


def _make(
    plan: ImportPlan, missing: Mapping[Path, Clip], scene_hash: str, advance: Callable[[], None]
) -> dict[Path, str]:
    """Write the missing files and return their SHA-256; in this process unless there is work for more."""
    num_workers = min(_workers_that_fit(plan), len(missing))
    if plan.settings.workers is None and sum(_num_bytes(plan, clip) for clip in missing.values()) < _WORTH_WORKERS:
        num_workers = 1
    if num_workers <= 1:
        hashes = {}
        for path, clip in missing.items():
            _write_clip(plan, clip, path, scene_hash)
            hashes[path] = file_sha256(path)
            advance()
        return hashes
    seed = plan.settings.seed
    job = ImportJob(plan.source, replace(plan.settings, format=plan.format), plan.found)
    jobs = {path: (seed, clip.split, int(path.stem), path, scene_hash) for path, clip in missing.items()}
    made = run_jobs(jobs, ("importers.clip_scene", job, "", None), environment(""), num_workers, advance)
    return {path: file.sha256 for path, file in made.items()}


def _write_clip(plan: ImportPlan, clip: Clip, path: Path, scene_hash: str) -> None:
    trajectory = clip_trajectory(plan, clip, scene_hash)
    settings = plan.settings
    write_trajectory(path, trajectory, compression=settings.compression, depth_encoding=settings.depth_encoding)


def _identity(plan: ImportPlan) -> dict[str, Any]:
    """Return everything that decides what the files hold, but for the pixels themselves."""
    digest = hashlib.sha256()
    for clip in plan.clips:
        recording = plan.sources[clip.recording.name]  # as given: refined poses differ in their last digits by machine
        arrays = [recording.intrinsics, recording.cam_to_world, recording.distortion]
        arrays += [array for camera in recording.depth_cameras if camera is not None for array in camera.arrays()]
        arrays += [] if recording.driven is None else list(recording.driven.as_arrays().values())
        facts = (recording.name, recording.height, recording.width, recording.num_frames, recording.frame_time)
        digest.update(repr((facts, sorted(recording.source.items()), clip.path.as_posix(), clip.frames)).encode())
        for array in arrays:
            digest.update(b"-" if array is None else array.tobytes())
    return {
        "scene": SCENE,
        "seed": plan.settings.seed,
        "importer_version": VERSION,
        "format": plan.format,
        "source": plan.source.name,
        "settings": {name: value for name, value in asdict(plan.settings).items() if name not in _NOT_IN_FILES},
        "mapping": file_sha256(Path(plan.settings.mapping))[:16] if plan.settings.mapping else "",
        "cameras_and_frames": digest.hexdigest()[:16],
        "bounds": {name: value for name, value in asdict(plan.bounds).items() if name not in _SAID},
    }


def _splits(plan: ImportPlan, folder: Path) -> dict[str, list[Path]]:
    splits: dict[str, list[Path]] = {split: [] for split in SPLITS}
    for clip in plan.clips:
        splits[clip.split].append(folder / clip.path)
    return splits


def _num_bytes(plan: ImportPlan, clip: Clip) -> int:
    geometry = plan.geometries[clip.recording.name]
    raw = len(clip.frames) * clip.recording.num_views * geometry.height * geometry.width * _BYTES_PER_PIXEL
    return int(raw * (1.0 if plan.settings.compression == "none" else _COMPRESSION_RATIO))


def _workers_that_fit(plan: ImportPlan) -> int:
    """Return the number of processes; each holds one trajectory in memory while it is written."""
    wanted = plan.settings.workers or num_cores()
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # a system that does not say
        return wanted
    largest = max(plan.clips, key=lambda clip: _num_bytes(plan, clip))
    needed = int(_num_bytes(plan, largest) / _COMPRESSION_RATIO)
    if needed > memory // 2:
        raise DataError(
            f"{largest.recording.name} as one trajectory of {len(largest.frames)} frames takes {needed / 2**30:.1f} "
            f"GiB of memory; this machine has {memory / 2**30:.1f}.\nCut it (clip_frames=100), or make it smaller "
            "(height=, every=)."
        )
    return max(1, min(wanted, memory // 2 // max(needed, 1)))


def _description(plan: ImportPlan) -> str:
    """Say what was found, what was estimated, and how to choose otherwise."""
    first = plan.clips[0].recording
    geometry = plan.geometries[first.name]
    counts: Sequence[str] = [f"{sum(clip.split == split for clip in plan.clips)} {split}" for split in SPLITS]
    conventions = ", ".join(f"{key} {value}" for key, value in first.source.items() if key != "format")
    lines = [
        f"{plan.source.name}: {plan.format}, {_counted(len(plan.geometries), 'recording')}, "
        f"{_counted(first.num_views, 'view')} of {first.width}x{first.height} pixels, {first.frame_time:g} s a frame",
        f"converted from: {conventions or 'our own conventions'}",
        f"to: {_counted(len(plan.clips), 'trajectory')} ({', '.join(counts)}) of "
        f"{geometry.width}x{geometry.height} pixels, {first.frame_time * plan.settings.every:g} s a frame",
    ]
    if plan.bounds.estimated:
        lines.append(f"estimated from the points: {', '.join(plan.bounds.estimated)}; to choose, give {plan.bounds}")
    else:
        lines.append(str(plan.bounds))
    odd = [side for side in (geometry.width, geometry.height) if side % _ENCODER_STEP]
    if odd:
        lines.append(
            f"{odd[0]} pixels is no multiple of {_ENCODER_STEP}, which encoder=unet needs (small ones: 4); choose "
            "another size with crop=, height= and width="
        )
    if plan.settings.recenter:
        lines.append(f"recentred: positions shifted by {plan.frame.shift.tolist()} m")
    return "\n".join(lines + plan.remarks)


def _counted(count: int, noun: str) -> str:
    plural = noun[:-1] + "ies" if noun.endswith("y") else noun + "s"
    return f"{count} {noun if count == 1 else plural}"
