"""A plain folder: images, depth images, and ``cameras.json``; the simplest way to hand over a recording.

A recording is one folder; a folder of such folders is several recordings, each named after its folder::

    my_recordings/
      first_take/
        cameras.json
        action.npz                                   optional: what a robot did (see ``plain_action``)
        left/rgb/000000.png      000001.png ...      8-bit PNG or JPEG, one size for all views
        left/depth/000000.png    000001.png ...      16-bit PNG or TIFF, or metres as float .npy or TIFF
        right/rgb/...
        right/depth/...
      second_take/...

Files are named by the number of the frame, in all folders the same numbers, without a gap: frame 12 of all views was
taken at the same moment. ``cameras.json``::

    {
      "frame_time": 0.05,              seconds from one frame to the next
      "axes": "opencv",                opencv: x right, y down, z forward; opengl: x right, y up, z back
      "pixel_center": 0.5,             where the first pixel's centre lies, as cx and cy count: 0.0 for calibrations by
                                       OpenCV, ROS and RealSense, 0.5 for COLMAP, nerfstudio and most renderers
      "depth_type": "z",               z: along the optical axis; distance: to the camera centre
      "depth_unit": 0.001,             metres per step of whole-number depth (not needed for .npy and TIFF in metres)
      "split": "train",                optional: train, validation or test
      "views": [
        {
          "name": "left",              the view's folder
          "fx": 615.0, "fy": 615.0, "cx": 320.0, "cy": 240.0,                  pixels; or "K": 3x3, row by row
          "distortion": [k1, k2, p1, p2, k3],                                  optional: OpenCV's 4, 5 or 8 numbers
          "cam_to_world": [[...], [...], [...], [0, 0, 0, 1]]                  4x4, metres; or "world_to_cam"
        },
        {"name": "right", ...}
      ]
    }

``K``, ``fx`` ..., and the pose may be lists with one entry per frame, for cameras that move or zoom. A view may have an
``axes``, ``pixel_center``, ``depth_type`` or ``depth_unit`` of its own. The conventions have no default values, because
a wrong one spoils a data set without a word; ``vpd-data validate`` checks against the data whether they fit.

Depth is in the colour camera's frame. A depth image of another size but the same field of view (phones) is fitted
to colour. Where a depth sensor beside the colour camera took it and nothing aligned it, the view describes that sensor,
and depth is registered to colour::

          "depth_camera": {
            "fx": 380.0, "fy": 380.0, "cx": 318.0, "cy": 241.0,                  pixels of the depth images; or "K"
            "distortion": [k1, k2, p1, p2, k3],                                  optional
            "depth_to_color": [[...], [...], [...], [0, 0, 0, 1]]                4x4, metres: points of the sensor's
          }                                                                      frame in the colour camera's; of both
                                                                                 x right, y down, z forward
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.conventions import (
    distance_to_z,
    join_views,
    opengl_to_opencv,
    shift_principal_point,
)
from data_gen.importers.depth_registration import DepthCamera
from data_gen.importers.images import COLOR_SUFFIXES, DEPTH_SUFFIXES, depth_size, image_size, read_color, read_depth
from data_gen.importers.plain_action import ACTION_FILE, read_action
from data_gen.importers.plain_cameras import (
    PIXEL_CENTERS,
    depth_camera,
    view_distortion,
    view_intrinsics,
    view_poses,
)
from data_gen.importers.recording import Recording
from data_gen.importers.settings import AUTO, ImportSettings
from data_gen.importers.source_files import choice, inside, positive, read_json
from vpd_lightning.data.manifest import SPLITS
from vpd_lightning.errors import DataError

FORMAT = "plain"
CAMERAS_FILE = "cameras.json"
_MAX_VIEWS = 256
_AXES = {"opencv": "x right, y down, z forward", "opengl": "x right, y up, z back"}
_DEPTH_TYPES = {"z": "along the optical axis", "distance": "to the camera centre"}


@dataclass(frozen=True)
class _View:
    """One view of one recording: its files by frame, its cameras in our conventions, how its depth is read."""

    color: list[Path]
    depth: list[Path]
    intrinsics: NDArray[np.float64]  # (3, 3) or (time, 3, 3)
    cam_to_world: NDArray[np.float64]  # (4, 4) or (time, 4, 4)
    distortion: NDArray[np.float64] | None
    depth_camera: DepthCamera | None
    depth_type: str
    depth_unit: float | None
    conventions: dict[str, str]


def matches(path: Path) -> bool:
    """Tell whether the folder, or one in it, has a ``cameras.json``."""
    if path.is_file():
        return path.name == CAMERAS_FILE
    return (path / CAMERAS_FILE).is_file() or any((folder / CAMERAS_FILE).is_file() for folder in path.iterdir())


def recordings(path: Path, settings: ImportSettings) -> Iterator[Recording]:
    """Read one recording's folder, or a folder of them.

    Raises:
        DataError: files are missing or broken, or ``cameras.json`` does not say what is needed.
    """
    path = path.parent if path.name == CAMERAS_FILE else path
    if not path.is_dir():
        raise DataError(f"{path} is no folder. A plain recording is a folder with {CAMERAS_FILE}.")
    folders = [path] if (path / CAMERAS_FILE).is_file() else sorted(x.parent for x in path.glob(f"*/{CAMERAS_FILE}"))
    if not folders:
        raise DataError(f"Neither {path} nor a folder in it has a {CAMERAS_FILE}.")
    for folder in folders:
        yield _recording(folder, settings)


def _recording(folder: Path, settings: ImportSettings) -> Recording:
    file = folder / CAMERAS_FILE
    content = read_json(file)
    listed = content.get("views")
    if not isinstance(listed, list) or not 0 < len(listed) <= _MAX_VIEWS:
        raise DataError(f"{file}: 'views' must be a list of 1 to {_MAX_VIEWS} cameras.")
    views = [_view(folder, file, index, entry, content, settings) for index, entry in enumerate(listed)]
    numbers = {len(view.color) for view in views}
    if len(numbers) > 1:
        counts = ", ".join(f"{entry['name']} {len(view.color)}" for entry, view in zip(listed, views, strict=True))
        raise DataError(f"{folder}: the views have different numbers of frames: {counts}.")
    height, width = image_size(views[0].color[0])

    def read_rgb(frame: int, view: int) -> NDArray[np.uint8]:
        return read_color(views[view].color[frame], height, width)

    def depth_of(frame: int, view: int) -> NDArray[np.float32]:
        chosen = views[view]
        sensor = chosen.depth_camera
        size = (height, width) if sensor is None else (sensor.height, sensor.width)
        depth = read_depth(chosen.depth[frame], *size, chosen.depth_unit, settings.depth_scale or 1.0)
        if chosen.depth_type == "z":
            return depth
        if sensor is not None:
            return distance_to_z(depth, sensor.intrinsics, sensor.distortion)
        matrix = chosen.intrinsics if chosen.intrinsics.ndim == 2 else chosen.intrinsics[frame]
        return distance_to_z(depth, matrix, chosen.distortion)

    return Recording(
        name=folder.name,
        height=height,
        width=width,
        intrinsics=join_views([view.intrinsics for view in views], numbers.pop()),
        cam_to_world=join_views([view.cam_to_world for view in views], len(views[0].color)),
        num_frames=len(views[0].color),
        num_views=len(views),
        frame_time=settings.frame_time or positive(content, "frame_time", str(file)),
        read_rgb=read_rgb,
        read_depth=depth_of,
        source={"format": FORMAT, **_common([view.conventions for view in views])},
        distortion=_distortions(views),
        view_names=[entry["name"] for entry in listed],
        depth_cameras=[view.depth_camera for view in views],
        driven=read_action(folder / ACTION_FILE, len(views[0].color)),
        split=choice(content, "split", str(file), dict.fromkeys(SPLITS, "")) if "split" in content else None,
    )


def _view(
    folder: Path, file: Path, index: int, entry: Any, content: Mapping[str, Any], settings: ImportSettings
) -> _View:
    if not isinstance(entry, dict):
        raise DataError(f'{file}: view {index} must be an object {{"name": ...}}.')
    images = inside(folder, entry.get("name"), f"{file}: view {index}: 'name'")
    where = f"{file}: view {entry['name']}"
    color, depth = _frames(images / "rgb", COLOR_SUFFIXES), _frames(images / "depth", DEPTH_SUFFIXES)
    if [path.stem for path in color] != [path.stem for path in depth]:
        only = {int(path.stem) for path in color} ^ {int(path.stem) for path in depth}
        what = f"frame {min(only)} is in one of them only" if only else "their names differ"
        raise DataError(f"{images}: rgb and depth do not belong together: {what}.")
    given = {**content, **entry}
    axes = settings.axes if settings.axes != AUTO else choice(given, "axes", where, _AXES)
    depth_type = settings.depth if settings.depth != AUTO else choice(given, "depth_type", where, _DEPTH_TYPES)
    if settings.pixel_center != AUTO:
        pixel_center = float(settings.pixel_center)
    else:
        pixel_center = float(choice(given, "pixel_center", where, PIXEL_CENTERS))
    unit = settings.depth_scale
    if unit is None and "depth_unit" in given:
        unit = positive(given, "depth_unit", where)
    intrinsics = shift_principal_point(view_intrinsics(entry, where, len(color)), 0.5 - pixel_center)
    poses = view_poses(entry, where, len(color))
    sensor = None
    if "depth_camera" in entry:
        sensor = depth_camera(entry, where, pixel_center, depth_size(depth[0]))
    conventions = {"axes": axes, "depth_type": depth_type, "pixel_center": f"{pixel_center:.1f}"}
    if unit is not None:
        conventions["depth_unit"] = f"{unit:.12g}"
    return _View(
        color=color,
        depth=depth,
        intrinsics=intrinsics,
        cam_to_world=opengl_to_opencv(poses) if axes == "opengl" else poses,
        distortion=view_distortion(entry, where),
        depth_camera=sensor,
        depth_type=depth_type,
        depth_unit=unit,
        conventions=conventions,
    )


def _frames(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Return the images of a folder by frame number; refuse gaps and strange names."""
    if not folder.is_dir():
        raise DataError(f"{folder} is missing. Images lie in VIEW/rgb and VIEW/depth beside {CAMERAS_FILE}.")
    files = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".")]
    if not files:
        raise DataError(f"{folder} holds no image ({', '.join(suffixes)}).")
    strange = sorted(path.name for path in files if not re.fullmatch(r"\d{1,9}", path.stem))
    if strange:
        raise DataError(f"{folder / strange[0]}: images must be named by the number of the frame, as 000012.png.")
    files.sort(key=lambda path: int(path.stem))
    numbers = [int(path.stem) for path in files]
    for before, after in zip(numbers, numbers[1:], strict=False):
        if after == before:
            raise DataError(f"{folder} holds frame {after} twice.")
        if after != before + 1:
            raise DataError(
                f"{folder}: frame {before + 1} is missing (the next is {after}).\nFrames must be evenly spaced in "
                "time: cut the recording there into two folders."
            )
    return files


def _distortions(views: list[_View]) -> NDArray[np.float64] | None:
    given = [view.distortion for view in views if view.distortion is not None]
    if not given:
        return None
    joined = np.zeros((len(views), max(map(len, given))))
    for index, view in enumerate(views):
        if view.distortion is not None:
            joined[index, : len(view.distortion)] = view.distortion
    return joined


def _common(conventions: list[dict[str, str]]) -> dict[str, str]:
    """Return what all views share; where they differ, the views' values in order."""
    keys = dict.fromkeys(key for entry in conventions for key in entry)
    joined = {key: [entry.get(key, "none") for entry in conventions] for key in keys}
    return {key: values[0] if len(set(values)) == 1 else " ".join(values) for key, values in joined.items()}
