"""Checking a data set: every file on its own, and whether depths and poses of different views agree.

The cross-view check unprojects the depth of one view, looks the points up in another, and compares distances. Wrong
conventions show at once; where another reading of axes or depth fits much better, the fault says which.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data import schema
from vpd_lightning.data.hdf5_checks import open_file
from vpd_lightning.data.manifest import FILE_NAME, file_sha256, load_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import DataError

MAX_RELATIVE_DISTANCE = 0.02  # of the depth: between correct sensors, after leaving out occlusions
_MUCH_BETTER = 0.5  # another convention is named when it reduces the distance below this share
_MIN_OVERLAP = 50  # pixels that two views must share to be compared
_MAX_PAIRS = 12
_MAX_FILES_COMPARED = 4
_MAX_PIXELS = 20_000

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong; ``is_error`` is false for a remark."""

    name: str
    file: str
    message: str
    is_error: bool = True

    def __str__(self) -> str:
        kind = "fault" if self.is_error else "remark"
        return f"{kind} {self.name}: {self.file}: {self.message}"


def validate_dataset(path: str | Path) -> list[Fault]:
    """Check a data set folder or one ``.h5`` file and return all faults; an empty list means none."""
    path = Path(path)
    if path.is_file():
        return validate_trajectory(path) + validate_views(path)
    faults: list[Fault] = []
    try:
        manifest = load_manifest(path)
        files = [file for members in manifest.splits.values() for file in members]
    except DataError as error:
        faults.append(Fault("manifest", FILE_NAME, _one_line(error)))
        manifest, files = None, sorted(path.glob("*/*.h5")) + sorted(path.glob("*.h5"))
        if not files:
            return faults
    shapes: dict[tuple[int, ...], Path] = {}
    healthy = []
    for file in files:
        found = validate_trajectory(file)
        if manifest is not None and file_sha256(file) != manifest.sha256[manifest.relative(file)]:
            found.append(Fault("checksum", str(file), f"its SHA-256 differs from {FILE_NAME}"))
        faults += found
        if not found:
            healthy.append(file)
            with TrajectoryReader(file) as reader:
                shapes.setdefault((reader.num_views, reader.height, reader.width), file)
    if len(shapes) > 1:
        listed = "; ".join(f"{shape} in {file.name}" for shape, file in shapes.items())
        faults.append(Fault("mixed_shapes", str(path), f"(views, height, width) differ between files: {listed}"))
    for file in healthy[:: max(1, len(healthy) // _MAX_FILES_COMPARED)][:_MAX_FILES_COMPARED]:
        faults += validate_views(file)
    return faults


def validate_trajectory(path: Path) -> list[Fault]:
    """Check one file: structure, cameras, that all bytes can be read, and plausible values."""
    try:
        with TrajectoryReader(path) as reader:
            faults = []
            num_measured, num_inside, num_nan = 0, 0, 0
            for time in range(reader.num_frames):
                reader.rgb([time])
                depth = reader.depth([time])
                if (depth < 0).any():
                    faults.append(Fault("negative_depth", str(path), f"frame {time} has negative depths"))
                    break
                num_measured += int((depth > 0).sum())
                num_nan += depth.size
                num_inside += _count_inside(reader, time, depth)
            faults += _check_state(path, reader)
    except DataError as error:
        return [Fault("unreadable", str(path), _one_line(error, str(path)))]
    if num_measured == 0:
        faults.append(Fault("no_depth", str(path), "not one pixel has a depth"))
    elif num_inside == 0:
        faults.append(
            Fault(
                "empty_workspace",
                str(path),
                "not one measured pixel lies in the workspace "
                "(are depth in metres, cam_to_world and workspace_min/max in one frame?)",
            )
        )
    return faults


def validate_views(path: Path, time: int = 0) -> list[Fault]:
    """Compare the views of one frame; see the module's text. Fewer than two views: nothing to compare."""
    errors = convention_errors(path, time)
    if not errors:
        return []
    used = errors["as stored"]
    best_name, best = min(errors.items(), key=lambda item: item[1])
    if used <= MAX_RELATIVE_DISTANCE:
        return []
    hint = f"; it would be {best:.2%} if {best_name}" if best < _MUCH_BETTER * used else ""
    return [
        Fault(
            "views_disagree",
            str(path),
            f"frame {time}: points seen by two views are {used:.2%} of their "
            f"distance apart (median; allowed {MAX_RELATIVE_DISTANCE:.0%}){hint}",
        )
    ]


def convention_errors(path: Path, time: int = 0) -> dict[str, float]:
    """Return, per reading of the conventions, the median distance between views relative to depth.

    ``as stored`` is the reading the format prescribes. Empty when the views share too few pixels. Occluded points are
    left out by taking, per pair, the better half of the distances: the same rule for every reading.
    """
    with TrajectoryReader(path) as reader:
        if reader.num_views < 2:
            return {}
        depth = reader.depth([time])[0].astype(np.float64)
        intrinsics, cam_to_world = (array[0] for array in reader.cameras([time]))
    errors = {}
    for name, reading in _readings().items():
        distances = list(_pair_distances(*reading(depth, intrinsics, cam_to_world)))
        if distances:
            errors[name] = float(np.median(distances))
        elif name != "as stored":
            continue
        else:
            errors[name] = float("inf")
    return errors if np.isfinite(list(errors.values())).any() else {}


def _readings() -> dict[str, Callable[[Array, Array, Array], tuple[Array, Array, Array]]]:
    """Other conventions that people use, as conversions to ours."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    return {
        "as stored": lambda d, k, p: (d, k, p),
        "the camera axes are OpenGL's (y up, z back): multiply cam_to_world by diag(1, -1, -1, 1)": lambda d, k, p: (
            d,
            k,
            p @ flip,
        ),
        "cam_to_world is world_to_cam: invert it": lambda d, k, p: (d, k, np.linalg.inv(p)),
        "cam_to_world is world_to_cam with OpenGL axes: invert it, then multiply by diag(1, -1, -1, 1)": (
            lambda d, k, p: (d, k, np.linalg.inv(p) @ flip)
        ),
        "depth is the distance to the camera centre: divide it by the length of the ray": lambda d, k, p: (
            d / _ray_lengths(d, k),
            k,
            p,
        ),
        "depth is the distance to the camera centre and the axes are OpenGL's": lambda d, k, p: (
            d / _ray_lengths(d, k),
            k,
            p @ flip,
        ),
        "depth is in millimetres: divide it by 1000": lambda d, k, p: (d / 1000.0, k, p),
    }


def _ray_lengths(depth: Array, intrinsics: Array) -> Array:
    return np.stack([np.linalg.norm(_rays(depth.shape[1:], matrix), axis=-1) for matrix in intrinsics])


def _rays(shape: tuple[int, ...], matrix: Array) -> Array:
    """Rays (height, width, 3) in the camera, one unit along the optical axis; pixel centres at +0.5."""
    v, u = np.meshgrid(np.arange(shape[0]) + 0.5, np.arange(shape[1]) + 0.5, indexing="ij")
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    return pixels @ np.linalg.inv(matrix).T


def _pair_distances(depth: Array, intrinsics: Array, cam_to_world: Array) -> Iterator[float]:
    num_views, height, width = depth.shape
    pairs = [(a, b) for a in range(num_views) for b in range(num_views) if a != b]
    for first, second in pairs[:: max(1, len(pairs) // _MAX_PAIRS)][:_MAX_PAIRS]:
        pose = cam_to_world[first]
        points = (_rays((height, width), intrinsics[first]) * depth[first][..., None])[depth[first] > 0]
        points = points[:: max(1, len(points) // _MAX_PIXELS)] @ pose[:3, :3].T + pose[:3, 3]
        inverse = np.linalg.inv(cam_to_world[second])
        seen = points @ inverse[:3, :3].T + inverse[:3, 3]
        seen = seen[seen[:, 2] > 1e-6]
        pixels = seen @ intrinsics[second].T
        column, row = np.floor(pixels[:, :2] / pixels[:, 2:]).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        measured = depth[second][row[inside].astype(int), column[inside].astype(int)]
        expected = seen[inside, 2]
        valid = measured > 0
        if valid.sum() >= _MIN_OVERLAP:
            relative = np.abs(measured[valid] - expected[valid]) / expected[valid]
            yield float(np.quantile(relative, 0.25))  # the median of the better half


def _count_inside(reader: TrajectoryReader, time: int, depth: NDArray[np.float32]) -> int:
    intrinsics, cam_to_world = (array[0] for array in reader.cameras([time]))
    count = 0
    for view in range(depth.shape[1]):
        image = depth[0, view].astype(np.float64)
        points = (_rays(image.shape, intrinsics[view]) * image[..., None])[image > 0]
        points = points @ cam_to_world[view, :3, :3].T + cam_to_world[view, :3, 3]
        count += int(((points >= reader.workspace_min) & (points <= reader.workspace_max)).all(axis=-1).sum())
    return count


def _check_state(path: Path, reader: TrajectoryReader) -> list[Fault]:
    """Ground truth, where there is any, must have one entry per frame."""
    with open_file(path) as file:
        group = file.get(schema.STATE)
        if not isinstance(group, h5py.Group):
            return []
        names = (schema.STATE_POSITIONS, schema.STATE_QUATERNIONS, schema.STATE_SEGMENTATION)
        wrong = [name for name in names if name in group and group[name].shape[0] != reader.num_frames]
    return [Fault("state_length", str(path), f"state/{name} has not one entry per frame") for name in wrong]


def _one_line(error: BaseException, prefix: str = "") -> str:
    return " ".join(str(error).removeprefix(prefix + ": ").split())
