"""A tiny data set for tests: two fixed cameras over a floor, and a bright square that moves."""

from pathlib import Path

import numpy as np

from vpd_lightning.data.manifest import Manifest, file_sha256, write_manifest
from vpd_lightning.data.schema import Trajectory, write_trajectory


def make_trajectory(
    seed: int, num_frames: int = 8, num_views: int = 2, size: int = 16, shift: float = 0.0
) -> Trajectory:
    """Cameras 1.5 m above the floor z = 0 look straight down; the moving square is 0.2 m above it."""
    draw = np.random.default_rng(seed)
    floor = np.random.default_rng(0).integers(60, 90, size=(num_views, size, size, 3))
    rgb = np.broadcast_to(floor, (num_frames, num_views, size, size, 3)).astype(np.uint8).copy()
    depth = np.full((num_frames, num_views, size, size), 1.5, np.float32)
    x, y = draw.integers(0, size // 2, size=2)
    for time in range(num_frames):
        block = (time, slice(None), slice(y, y + 3), slice((x + time) % (size - 3), (x + time) % (size - 3) + 3))
        rgb[block] = [250, 40 * (seed % 5), 20]
        depth[block] = 1.3
    intrinsics = np.array([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1]], np.float64)
    poses = []
    for view in range(num_views):
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = [0.1 * view + shift, 0.0, 1.5]
        poses.append(pose)
    return Trajectory(
        rgb=rgb,
        depth=depth,
        intrinsics=np.repeat(intrinsics[None], num_views, axis=0),
        cam_to_world=np.stack(poses),
        frame_time=0.05,
        near=0.3,
        far=5.0,
        workspace_min=(-1.0, -1.0, -1.0),
        workspace_max=(1.0, 1.0, 1.0),
        seed=seed,
    )


def write_recordings(folder: Path, num_train: int = 4, num_validation: int = 2, **kwargs: int) -> Path:
    """Write a data set and return its folder."""
    splits: dict[str, list[Path]] = {"train": [], "validation": [], "test": []}
    for split, count, first in (("train", num_train, 0), ("validation", num_validation, 100)):
        for index in range(count):
            path = folder / split / f"{index:06d}.h5"
            write_trajectory(path, make_trajectory(first + index, **kwargs))
            splits[split].append(path)
    return write_dataset_file(folder, splits)


def write_dataset_file(folder: Path, splits: dict[str, list[Path]]) -> Path:
    """Write ``dataset.json`` over existing files."""
    files = [path for paths in splits.values() for path in paths]
    names = {path: path.relative_to(folder).as_posix() for path in files}
    write_manifest(
        Manifest(
            folder=folder,
            name="recordings",
            scene="squares",
            preset="tiny",
            seed=0,
            splits=splits,
            sha256={names[path]: file_sha256(path) for path in files},
            num_bytes={names[path]: path.stat().st_size for path in files},
        )
    )
    return folder
