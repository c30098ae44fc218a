"""What every importer must get right, checked against the known scene."""

from pathlib import Path

import h5py
import numpy as np

from data_gen.inspection.validate import validate_dataset
from tests.data_gen.importers import known_scene
from vpd_lightning.data.reader import TrajectoryReader

TOLERANCE = 1e-4  # m: half a step of the samples' 16-bit depth is 0.05 mm; float32 adds less than 0.001 mm


def worst_point(path: Path, times: list[float]) -> float:
    """Largest distance of an unprojected pixel to the scene's surfaces; ``times`` of the file's frames, in seconds."""
    worst = 0.0
    with TrajectoryReader(path) as reader:
        assert reader.num_frames == len(times)
        depth = reader.depth()
        intrinsics, poses = reader.cameras()
        for frame, time in enumerate(times):
            for view in range(reader.num_views):
                points = known_scene.unproject(depth[frame, view], intrinsics[frame, view], poses[frame, view])
                assert len(points) > 0.9 * depth[frame, view].size
                worst = max(worst, float(known_scene.distance_to_surfaces(points, time).max()))
    return worst


def camera_errors(path: Path, intrinsics: np.ndarray, poses: np.ndarray) -> tuple[float, float]:
    """Largest differences of the stored cameras to the true ones, (view, ...) or (time, view, ...)."""
    with TrajectoryReader(path) as reader:
        stored = reader.cameras()
    return float(np.abs(stored[0] - intrinsics).max()), float(np.abs(stored[1] - poses).max())


def attributes(path: Path) -> dict[str, object]:
    with h5py.File(path) as file:
        return dict(file.attrs)


def files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*/*.h5"))


def assert_valid(folder: Path) -> None:
    assert [str(fault) for fault in validate_dataset(folder) if fault.is_error] == []
