"""TUM RGB-D sequences: ``rgb.txt``, ``depth.txt`` and ``groundtruth.txt`` beside the images they name.

One moving camera. Depth is 16 bits, 5000 steps a metre, along the optical axis. The three lists have their own times:
a depth image belongs to the colour image nearest in time, and the pose is interpolated at the colour image's time.
Where a colour image finds no depth image or no pose, the sequence is cut.

Calibration comes from ``calibration.yaml`` in the folder (or ``mapping=FILE``) with ``fx fy cx cy`` in pixels, pixel
centres at integers, and where known ``distortion`` (k1 k2 p1 p2 k3) and ``depth_scale`` (metres per step); otherwise
from the name of the folder (freiburg1, freiburg2, freiburg3, or fr1, fr2, fr3).
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from data_gen.importers.conventions import (
    camera_matrix,
    checked_intrinsics,
    distance_to_z,
    opengl_to_opencv,
    pose_matrix,
    rotation_from_quaternion,
    shift_principal_point,
)
from data_gen.importers.frame_times import PoseTrack, Times, nearest, pose_gap, runs_without_gap, usual_step
from data_gen.importers.images import image_size, read_color, read_depth
from data_gen.importers.recording import MIN_FRAMES, Recording
from data_gen.importers.settings import ImportSettings, chosen
from data_gen.importers.source_files import inside
from vpd_lightning.errors import DataError, one_line

FORMAT = "tum"
_LISTS = ("rgb.txt", "depth.txt", "groundtruth.txt")
_CALIBRATION = "calibration.yaml"
_METRES_PER_STEP = 1 / 5000
# The data set's own calibrations of its colour cameras: fx fy cx cy, then k1 k2 p1 p2 k3. Its authors offer 525 525
# 319.5 239.5 without distortion too, which fits the depth images' registration but not the lens.
_KINECTS: dict[str, tuple[list[float], list[float]]] = {
    "1": ([517.3, 516.5, 318.6, 255.3], [0.2624, -0.9531, -0.0054, 0.0026, 1.1633]),
    "2": ([520.9, 521.0, 325.1, 249.7], [0.2312, -0.7849, -0.0033, -0.0001, 0.9172]),
    "3": ([535.4, 539.2, 320.1, 247.6], [0.0, 0.0, 0.0, 0.0, 0.0]),
}


@dataclass(frozen=True)
class _Calibration:
    intrinsics: NDArray[np.float64]
    distortion: NDArray[np.float64]
    depth_scale: float


def matches(path: Path) -> bool:
    """Tell whether the folder, or one in it, has the lists of a TUM sequence."""
    if not path.is_dir():
        return False
    return any(all((folder / name).is_file() for name in _LISTS[:2]) for folder in [path, *_subfolders(path)])


def recordings(path: Path, settings: ImportSettings) -> Iterator[Recording]:
    """Read one sequence, or all sequences in a folder; one recording per stretch without a gap.

    Raises:
        DataError: a list, an image or the calibration is missing or damaged, or nothing fits together in time.
    """
    sequences = [folder for folder in [path, *_subfolders(path)] if (folder / _LISTS[0]).is_file()]
    if not sequences:
        raise DataError(f"{path} holds no TUM sequence (a folder with {', '.join(_LISTS)}).")
    for folder in sequences:
        yield from _sequence(folder, settings)


def _subfolders(path: Path) -> list[Path]:
    return sorted(folder for folder in path.iterdir() if folder.is_dir())


def _sequence(folder: Path, settings: ImportSettings) -> Iterator[Recording]:
    for name in _LISTS:
        if not (folder / name).is_file():
            hint = " Without poses it cannot be used." if name == _LISTS[2] else ""
            raise DataError(f"{folder} has no {name}.{hint}")
    calibration = _calibration(folder, settings)
    times, images = _image_list(folder / _LISTS[0])
    depth_times, depth_images = _image_list(folder / _LISTS[1])
    track = _ground_truth(folder / _LISTS[2], settings)
    difference = round(settings.max_time_difference * 1e9)
    partner = nearest(depth_times, times, difference)
    poses, is_posed = track.at(times, pose_gap(settings.max_time_difference))
    frames = np.flatnonzero((partner >= 0) & is_posed)
    frame_time = usual_step(times)
    stretches = runs_without_gap(times[frames], frame_time) if len(frames) else []
    if not stretches:
        raise DataError(
            f"{folder}: of {len(times)} colour images {int((partner >= 0).sum())} have a depth image within "
            f"{settings.max_time_difference} s and {int(is_posed.sum())} a pose; nowhere do {MIN_FRAMES} follow each "
            "other.\nAre the three lists from one clock? Otherwise raise max_time_difference."
        )
    height, width = image_size(images[0])
    for number, stretch in enumerate(stretches):
        kept = frames[stretch]
        yield _recording(
            folder.name if len(stretches) == 1 else f"{folder.name}/part{number}",
            (height, width),
            [images[i] for i in kept],
            [depth_images[partner[i]] for i in kept],
            poses[kept],
            settings.frame_time or frame_time,
            calibration,
            settings,
        )


def _recording(
    name: str,
    size: tuple[int, int],
    images: list[Path],
    depth_images: list[Path],
    poses: NDArray[np.float64],
    frame_time: float,
    calibration: _Calibration,
    settings: ImportSettings,
) -> Recording:
    distortion = calibration.distortion if np.any(calibration.distortion) else None

    def read_rgb(frame: int, view: int) -> NDArray[np.uint8]:
        return read_color(images[frame], *size)

    def read_metres(frame: int, view: int) -> NDArray[np.float32]:
        depth = read_depth(depth_images[frame], *size, metres_per_step=calibration.depth_scale)
        if chosen(settings.depth, "z") == "distance":
            return distance_to_z(depth, calibration.intrinsics, distortion)
        return depth

    return Recording(
        name=name,
        height=size[0],
        width=size[1],
        intrinsics=calibration.intrinsics[None],
        cam_to_world=poses[:, None],
        num_frames=len(images),
        num_views=1,
        frame_time=frame_time,
        read_rgb=read_rgb,
        read_depth=read_metres,
        source={
            "format": FORMAT,
            "axes": chosen(settings.axes, "opencv"),
            "depth_type": chosen(settings.depth, "z"),
            "depth_unit": f"{calibration.depth_scale:.9g}",
            "pixel_center": chosen(settings.pixel_center, "0.0"),
        },
        distortion=None if distortion is None else distortion[None],
    )


def _calibration(folder: Path, settings: ImportSettings) -> _Calibration:
    file = Path(settings.mapping) if settings.mapping else folder / _CALIBRATION
    scale = _METRES_PER_STEP
    if file.is_file():
        numbers, distortion, scale = _read_calibration(file)
    elif settings.mapping:
        raise DataError(f"mapping={file} does not exist.")
    else:
        found = re.search(r"(?:freiburg|fr)([123])(?!\d)", folder.name, re.IGNORECASE)
        if found is None:
            raise DataError(
                f"{folder}: the camera's calibration is missing; only freiburg1 to freiburg3 are known by name.\n"
                f"Write {file} with fx, fy, cx, cy in pixels (and distortion: [k1, k2, p1, p2, k3])."
            )
        numbers, distortion = _KINECTS[found[1]]
    intrinsics = checked_intrinsics(camera_matrix(*numbers), str(file))
    if chosen(settings.pixel_center, "0.0") == "0.0":
        intrinsics = shift_principal_point(intrinsics, 0.5)
    return _Calibration(intrinsics, np.array(distortion, np.float64), settings.depth_scale or scale)


def _read_calibration(file: Path) -> tuple[list[float], list[float], float]:
    try:
        values = yaml.safe_load(file.read_text())
        numbers = [float(values[key]) for key in ("fx", "fy", "cx", "cy")]
        distortion = [float(value) for value in values.get("distortion", [0.0] * 5)]
        scale = float(values.get("depth_scale", _METRES_PER_STEP))
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{file} lacks the numbers fx, fy, cx, cy, or is no YAML ({one_line(error)}).") from error
    if len(distortion) not in (4, 5, 8) or not np.isfinite(distortion).all() or not 0 < scale < float("inf"):
        raise DataError(f"{file}: distortion must be 4, 5 or 8 numbers (k1 k2 p1 p2 ...), depth_scale above 0.")
    return numbers, distortion + [0.0] * (len(distortion) == 4), scale


def _image_list(path: Path) -> tuple[Times, list[Path]]:
    """Return times (ns, increasing) and image paths of ``rgb.txt`` or ``depth.txt``."""
    entries: dict[int, Path] = {}
    for number, words in _lines(path):
        if len(words) != 2:
            raise DataError(f"{path}, line {number}: a time and a file name were expected.")
        entries[_nanoseconds(words[0], path, number)] = inside(path.parent, words[1], f"{path}, line {number}")
    if not entries:
        raise DataError(f"{path} lists no image.")
    times = sorted(entries)
    return np.array(times, np.int64), [entries[time] for time in times]


def _ground_truth(path: Path, settings: ImportSettings) -> PoseTrack:
    poses: dict[int, list[float]] = {}
    for number, words in _lines(path):
        try:
            values = [float(word) for word in words[1:]]
        except ValueError:
            values = []
        if len(values) != 7 or not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1) > 0.01:
            raise DataError(f"{path}, line {number}: not a time, tx ty tz and a unit quaternion qx qy qz qw.")
        poses[_nanoseconds(words[0], path, number)] = values
    if not poses:
        raise DataError(f"{path} lists no pose.")
    times = sorted(poses)
    numbers = np.array([poses[time] for time in times])
    matrices = pose_matrix(rotation_from_quaternion(numbers[:, 3:], "xyzw"), numbers[:, :3])
    if chosen(settings.axes, "opencv") == "opengl":
        matrices = opengl_to_opencv(matrices)
    return PoseTrack(np.array(times, np.int64), matrices)


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield number and words of the lines that are no comment."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read as text.") from error
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#")[0].replace(",", " ").split()
        if words:
            yield number, words


def _nanoseconds(word: str, path: Path, number: int) -> int:
    try:
        time = int((Decimal(word) * 10**9).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        time = 2**63
    if abs(time) >= 2**62:
        raise DataError(f"{path}, line {number}: {word!r} is not a time in seconds.")
    return time
