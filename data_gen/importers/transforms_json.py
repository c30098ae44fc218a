"""``transforms.json`` of nerfstudio and instant-ngp, with times.

Each entry of ``frames`` has ``file_path``, ``transform_matrix`` (camera to world, OpenGL axes) and a depth image,
``depth_file_path`` (nerfstudio) or ``depth_path`` (instant-ngp). Two more keys say what those programs do not need:
``time`` in seconds and ``camera`` (or ``camera_id``). Without them, several cameras are separated by their folders or
by ``cam3`` (``camera``, ``view``) in the file names, and frames by the last number in the name.

Cameras: ``fl_x fl_y cx cy w h k1 k2 k3 p1 p2``, for all frames or in each, or ``camera_angle_x``. The principal point
counts pixel centres at +0.5, as COLMAP and nerfstudio do. Depth: whole numbers and ``.npy`` values times
``depth_scale=``, else ``integer_depth_scale`` or ``depth_unit_scale_factor`` of the file, else 0.001, nerfstudio's
default; along the optical axis unless ``depth=distance``.

The world is taken as it is written. nerfstudio turns it when it makes the file and says so in ``applied_transform``;
``undo_applied_transform=true`` turns it back. Recentring and rescaling happen in nerfstudio's loader, not in the file.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.conventions import (
    camera_matrix,
    checked_intrinsics,
    checked_pose,
    distance_to_z,
    invert_pose,
    opengl_to_opencv,
    shift_principal_point,
)
from data_gen.importers.images import image_size, read_color, read_depth
from data_gen.importers.recording import Recording
from data_gen.importers.settings import ImportSettings, chosen
from data_gen.importers.shot_order import Shot, ShotOrder, order_shots
from data_gen.importers.source_files import inside, number, positive, read_json
from vpd_lightning.errors import DataError

FORMAT = "transforms"
FILE_NAME = "transforms.json"
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_MAX_FRAMES = 1_000_000
_METRES_PER_STEP = 0.001  # nerfstudio's default, for whole numbers and .npy alike


@dataclass(frozen=True)
class _Frame:
    """One entry of ``frames``, converted but for its lens."""

    color: Path
    depth: Path
    size: tuple[int, int]
    intrinsics: NDArray[np.float64]
    cam_to_world: NDArray[np.float64]
    distortion: tuple[float, ...]


def matches(path: Path) -> bool:
    """Tell whether the path is, or holds, a ``transforms.json``."""
    if path.is_file():
        return path.suffix == ".json" and path.name.startswith("transforms")
    return (path / FILE_NAME).is_file() or any(True for _ in path.glob(f"*/{FILE_NAME}"))


def recordings(path: Path, settings: ImportSettings) -> Iterator[Recording]:
    """Read one file, or those of all folders in a folder.

    Raises:
        DataError: a file is broken, has a camera model that is no pinhole, or does not say what was taken when.
    """
    if path.is_file():
        files = [path]
    else:
        files = [path / FILE_NAME] if (path / FILE_NAME).is_file() else sorted(path.glob(f"*/{FILE_NAME}"))
    if not files:
        raise DataError(f"Neither {path} nor a folder in it has a {FILE_NAME}.")
    for file in files:
        yield _recording(file, settings)


def _recording(file: Path, settings: ImportSettings) -> Recording:
    content = read_json(file)
    entries = content.get("frames")
    if not isinstance(entries, list) or not 0 < len(entries) <= _MAX_FRAMES:
        raise DataError(f"{file}: 'frames' must be a list of 1 to {_MAX_FRAMES} images.")
    if not all(isinstance(entry, dict) for entry in entries):
        raise DataError(f"{file}: each entry of 'frames' must be an object {{\"file_path\": ...}}.")
    shots = [_shot(entry, index, file) for index, entry in enumerate(entries)]
    order = order_shots(shots, _frame_time(content, file), settings, str(file))
    undo = _applied_transform(content, file) if settings.undo_applied_transform else None
    frames = [_frame(file, index, entry, content, settings, undo) for index, entry in enumerate(entries)]
    height, width = _common_size(frames, file)
    intrinsics = _by_time_and_view([frame.intrinsics for frame in frames], order)
    distortion = _distortion(frames, order, file)
    unit = _depth_unit(content, file, settings)
    depth_type = chosen(settings.depth, "z")
    lens = distortion if np.any(distortion) else None

    def read_rgb(time: int, view: int) -> NDArray[np.uint8]:
        return read_color(frames[order.index[time][view]].color, height, width)

    def depth_of(time: int, view: int) -> NDArray[np.float32]:
        depth = read_depth(frames[order.index[time][view]].depth, height, width, unit, unit)
        if depth_type == "z":
            return depth
        matrix = intrinsics[view] if intrinsics.ndim == 3 else intrinsics[time, view]
        return distance_to_z(depth, matrix, None if lens is None else lens[view])

    return Recording(
        name=file.parent.name if file.name == FILE_NAME else file.stem,
        height=height,
        width=width,
        intrinsics=intrinsics,
        cam_to_world=_by_time_and_view([frame.cam_to_world for frame in frames], order),
        num_frames=len(order.index),
        num_views=len(order.views),
        frame_time=order.frame_time,
        read_rgb=read_rgb,
        read_depth=depth_of,
        source={
            "format": FORMAT,
            "axes": chosen(settings.axes, "opengl"),
            "depth_type": depth_type,
            "depth_unit": f"{unit:.12g}",
            "pixel_center": chosen(settings.pixel_center, "0.5"),
            **_world_notes(content, settings),
        },
        distortion=lens,
    )


def _shot(entry: Mapping[str, Any], index: int, file: Path) -> Shot:
    where = f"{file}, frame {index}"
    name = entry.get("file_path")
    if not isinstance(name, str):
        raise DataError(f"{where}: 'file_path' is {name!r}; a file name is needed.")
    camera = next((entry[key] for key in ("camera", "camera_id") if entry.get(key) is not None), None)
    if camera is not None and (isinstance(camera, bool) or not isinstance(camera, str | int)):
        raise DataError(f"{where}: 'camera' is {camera!r}; a name or a whole number is needed.")
    key = next((key for key in ("time", "timestamp") if key in entry), None)
    time = number(entry, key, where) if key else None
    return Shot(name.replace("\\", "/").removeprefix("./"), None if camera is None else str(camera), time)


def _frame(
    file: Path,
    index: int,
    entry: Mapping[str, Any],
    content: Mapping[str, Any],
    settings: ImportSettings,
    undo: NDArray[np.float64] | None,
) -> _Frame:
    where = f"{file}, frame {index}"
    given = {**content, **entry}
    _refuse_other_lenses(given, where)
    color = inside(file.parent, entry["file_path"], f"{where}: 'file_path'")
    if not color.suffix:  # synthetic scenes leave it out
        color = color.with_suffix(".png")
    depth_name = next((entry[key] for key in ("depth_file_path", "depth_path") if entry.get(key)), None)
    if depth_name is None:
        raise DataError(f"{where}: no 'depth_file_path' (nor 'depth_path').\nParticles need depth for every image.")
    pose = checked_pose(entry.get("transform_matrix", "missing"), f"{where}: 'transform_matrix'")
    if undo is not None:
        pose = undo @ pose
    size = _size(given, color, where)
    shift = 0.5 - float(chosen(settings.pixel_center, "0.5"))
    return _Frame(
        color=color,
        depth=inside(file.parent, depth_name, f"{where}: 'depth_file_path'"),
        size=size,
        intrinsics=shift_principal_point(_intrinsics(entry, content, size, where), shift),
        cam_to_world=opengl_to_opencv(pose) if chosen(settings.axes, "opengl") == "opengl" else pose,
        distortion=tuple(number(given, key, where, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")),
    )


def _refuse_other_lenses(given: Mapping[str, Any], where: str) -> None:
    model = str(given.get("camera_model", "OPENCV"))
    if given.get("is_fisheye") is True or model.upper() not in _PERSPECTIVE:
        name = "a fisheye lens" if given.get("is_fisheye") is True else model
        raise DataError(
            f"{where} was taken with {name}; only pinhole cameras with OpenCV's distortion can be imported.\n"
            "Undistort the images to pinholes first (cv2.fisheye.undistortImage, or COLMAP's image_undistorter)."
        )
    if number(given, "k4", where, 0.0) != 0:
        raise DataError(
            f"{where}: 'k4' is {given['k4']}, a term that OpenCV's model has not.\nUndistort the images first."
        )


def _size(given: Mapping[str, Any], color: Path, where: str) -> tuple[int, int]:
    if "w" not in given or "h" not in given:
        return image_size(color)
    height, width = (positive(given, key, where) for key in ("h", "w"))
    if height != int(height) or width != int(width):
        raise DataError(f"{where}: 'w' and 'h' are {width:g} and {height:g}; whole numbers are needed.")
    return int(height), int(width)


def _intrinsics(
    entry: Mapping[str, Any], content: Mapping[str, Any], size: tuple[int, int], where: str
) -> NDArray[np.float64]:
    """Take the frame's own values first, then the file's; focal lengths in pixels before angles."""
    height, width = size
    for given in (entry, content):
        if "fl_x" in given or "camera_angle_x" in given:
            fx = number(given, "fl_x", where) if "fl_x" in given else _focal(given, "camera_angle_x", width, where)
            if "fl_y" in given:
                fy = number(given, "fl_y", where)
            else:
                fy = _focal(given, "camera_angle_y", height, where) if "camera_angle_y" in given else fx
            both = {**content, **entry}
            cx, cy = number(both, "cx", where, width / 2), number(both, "cy", where, height / 2)
            return checked_intrinsics(camera_matrix(fx, fy, cx, cy), f"{where}: fl_x, fl_y, cx, cy")
    raise DataError(f"{where}: neither 'fl_x' (pixels) nor 'camera_angle_x' (radians) is given.")


def _focal(given: Mapping[str, Any], key: str, side: int, where: str) -> float:
    angle = number(given, key, where)
    if not 0 < angle < math.pi:
        raise DataError(f"{where}: {key!r} is {angle:g}; an angle of view in radians is needed.")
    return 0.5 * side / math.tan(0.5 * angle)


def _common_size(frames: Sequence[_Frame], file: Path) -> tuple[int, int]:
    sizes = {frame.size: index for index, frame in enumerate(frames)}
    if len(sizes) > 1:
        listed = ", ".join(f"{w}x{h} (frame {index})" for (h, w), index in list(sizes.items())[:4])
        raise DataError(f"{file}: the images differ in size: {listed}.\nAll cameras of a recording must have one size.")
    height, width = next(iter(sizes))
    found = image_size(frames[0].color)
    if found != (height, width):
        raise DataError(
            f"{frames[0].color} is {found[1]}x{found[0]} pixels, {file.name} says {width}x{height}.\n"
            "If the images were made smaller, fl_x, fl_y, cx, cy, w and h must follow."
        )
    return height, width


def _by_time_and_view(matrices: Sequence[NDArray[np.float64]], order: ShotOrder) -> NDArray[np.float64]:
    """Return (view, n, n) where nothing changes in time, else (time, view, n, n)."""
    table = np.stack([np.stack([matrices[index] for index in row]) for row in order.index])
    return table[0] if (table == table[:1]).all() else table


def _distortion(frames: Sequence[_Frame], order: ShotOrder, file: Path) -> NDArray[np.float64]:
    for view, name in enumerate(order.views):
        if len({frames[row[view]].distortion for row in order.index}) > 1:
            raise DataError(
                f"{file}: the distortion of camera {name or 'one'!r} changes with time; that is not supported."
            )
    return np.array([frames[index].distortion for index in order.index[0]])


def _frame_time(content: Mapping[str, Any], file: Path) -> float | None:
    if "frame_time" in content:
        return positive(content, "frame_time", str(file))
    return 1.0 / positive(content, "fps", str(file)) if "fps" in content else None


def _depth_unit(content: Mapping[str, Any], file: Path, settings: ImportSettings) -> float:
    if settings.depth_scale is not None:
        return settings.depth_scale
    for key in ("integer_depth_scale", "depth_unit_scale_factor"):
        if key in content:
            return positive(content, key, str(file))
    return _METRES_PER_STEP


def _applied_transform(content: Mapping[str, Any], file: Path) -> NDArray[np.float64]:
    if "applied_transform" not in content:
        raise DataError(f"{file} has no 'applied_transform' to undo; leave out undo_applied_transform=true.")
    return invert_pose(checked_pose(content["applied_transform"], f"{file}: 'applied_transform'"))


def _world_notes(content: Mapping[str, Any], settings: ImportSettings) -> dict[str, str]:
    if "applied_transform" not in content:
        return {}
    state = "undone" if settings.undo_applied_transform else "kept"
    return {"applied_transform": f"{state}: {str(content['applied_transform'])[:400]}"}
