"""Kubric output folders: ``metadata.json`` beside ``rgba_00000.png`` and ``depth_00000.tiff``.

A folder with ``metadata.json`` is one recording of one camera. A folder whose sub-folders are named ``view0``,
``camera_1``, ``cam2``, ... and each hold such output is one recording of several cameras; any other folder of folders
is a source of many recordings.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.images import image_size, read_color, read_depth
from data_gen.importers.kubric_camera import (
    FRAME_RATE,
    kubric_depth,
    kubric_intrinsics,
    kubric_poses,
    kubric_source,
)
from data_gen.importers.recording import Recording
from data_gen.importers.settings import ImportSettings
from data_gen.importers.source_files import read_json
from vpd_lightning.errors import DataError

FORMAT = "kubric"
_METADATA = "metadata.json"
_VIEW_NAME = re.compile(r"(view|camera|cam)[_-]?\d+$", re.IGNORECASE)
_COLOUR_LAYERS = (("rgba", "png"), ("rgb", "png"))


@dataclass(frozen=True)
class _View:
    """One folder of Kubric output."""

    folder: Path
    height: int
    width: int
    frame_rate: float
    intrinsics: NDArray[np.float64]
    poses: NDArray[np.float64]
    rgb: list[Path]
    depth: list[Path]


def matches(path: Path) -> bool:
    """Tell whether the folder, or a folder in it, is Kubric output."""
    if not path.is_dir():
        return False
    folders = [path, *_subfolders(path)]
    folders += [inner for folder in folders[1:9] for inner in _subfolders(folder)[:8]]
    return any((folder / _METADATA).is_file() and any(folder.glob("depth_*.tif*")) for folder in folders)


def recordings(path: Path, settings: ImportSettings) -> Iterator[Recording]:
    """Read one scene, or all scenes in a folder, in the order of their names.

    Raises:
        DataError: a scene is incomplete, or its views do not fit together.
    """
    scenes = list(_scenes(path))
    if not scenes:
        raise DataError(f"{path} holds no Kubric output: no folder in it has a {_METADATA}.")
    for name, folders in scenes:
        yield _recording(name, [_read_view(folder, settings) for folder in folders], settings)


def _scenes(path: Path) -> Iterator[tuple[str, list[Path]]]:
    """Yield the name and the view folders of each scene."""
    if (path / _METADATA).is_file():
        yield path.name, [path]
        return
    inner = _subfolders(path)
    views = [folder for folder in inner if _VIEW_NAME.match(folder.name) and (folder / _METADATA).is_file()]
    if views:
        yield path.name, views
        return
    for folder in inner:
        for name, folders in _scenes(folder):
            yield (name if name == folder.name else f"{folder.name}/{name}"), folders


def _subfolders(path: Path) -> list[Path]:
    """Return folders with numbers in their names in the order of these numbers."""
    found = [folder for folder in path.iterdir() if folder.is_dir() and not folder.name.startswith(".")]
    return sorted(found, key=lambda folder: [int(t) if t.isdigit() else t for t in re.split(r"(\d+)", folder.name)])


def _recording(name: str, views: list[_View], settings: ImportSettings) -> Recording:
    first = views[0]
    for view in views[1:]:
        for what in ("height", "width", "frame_rate"):
            if getattr(view, what) != getattr(first, what):
                raise DataError(
                    f"{view.folder} has {what} {getattr(view, what)}, {first.folder} has {getattr(first, what)}.\n"
                    "Views of one scene must agree."
                )
        if len(view.rgb) != len(first.rgb):
            raise DataError(f"{view.folder} has {len(view.rgb)} frames, {first.folder} has {len(first.rgb)}.")
    if all(view.poses.ndim == 2 for view in views):
        cam_to_world = np.stack([view.poses for view in views])
    else:
        shape = (len(first.rgb), 4, 4)
        cam_to_world = np.stack([np.broadcast_to(view.poses, shape) for view in views], axis=1)

    def read_rgb(frame: int, view: int) -> NDArray[np.uint8]:
        return read_color(views[view].rgb[frame], first.height, first.width)  # without alpha, as in the MOVi sets

    def read_metres(frame: int, view: int) -> NDArray[np.float32]:
        layer = read_depth(views[view].depth[frame], first.height, first.width, metres_per_step=None)
        return kubric_depth(layer, views[view].intrinsics, settings)

    return Recording(
        name=name,
        height=first.height,
        width=first.width,
        intrinsics=np.stack([view.intrinsics for view in views]),
        cam_to_world=cam_to_world,
        num_frames=len(first.rgb),
        num_views=len(views),
        frame_time=settings.frame_time or 1.0 / first.frame_rate,
        read_rgb=read_rgb,
        read_depth=read_metres,
        source=kubric_source(FORMAT, settings),
    )


def _read_view(folder: Path, settings: ImportSettings) -> _View:
    metadata = _read_metadata(folder / _METADATA)
    camera, scene = metadata["camera"], metadata["metadata"]
    where = f"{folder.name}/{_METADATA}, camera"
    rgb = next((found for layer, suffix in _COLOUR_LAYERS if (found := _layer(folder, layer, suffix))), {})
    depth = _layer(folder, "depth", "tif*")
    if not rgb or not depth:
        missing = "depth_00000.tiff" if rgb else "rgba_00000.png"
        raise DataError(f"{folder} has no {missing}, ...: that layer was not rendered, or not written.")
    if list(rgb) != list(range(len(rgb))) or list(depth) != list(rgb):
        frame = min(set(range(max(max(rgb), max(depth)) + 1)) - (set(rgb) & set(depth)))
        raise DataError(f"{folder}: frame {frame} lacks its colour or its depth image.")
    expected = scene.get("num_frames", len(rgb))
    if expected != len(rgb):
        raise DataError(f"{folder} has {len(rgb)} frames, its {_METADATA} says {expected}. Was rendering interrupted?")
    height, width = _resolution(scene, rgb[0])
    return _View(
        folder,
        height,
        width,
        float(scene.get("frame_rate", metadata.get("flags", {}).get("frame_rate", FRAME_RATE))),
        kubric_intrinsics(camera, height, width, settings, where),
        kubric_poses(camera, len(rgb), settings, where),
        list(rgb.values()),
        list(depth.values()),
    )


def _read_metadata(path: Path) -> dict[str, Any]:
    metadata = read_json(path)
    if not all(isinstance(metadata.get(key), dict) for key in ("camera", "metadata")):
        raise DataError(f"{path} lacks 'camera' or 'metadata'; it is not what Kubric's workers write.")
    return metadata


def _layer(folder: Path, layer: str, suffix: str) -> dict[int, Path]:
    """Return the images of a layer by frame number, in order."""
    found = {int(path.stem.rpartition("_")[2]): path for path in folder.glob(f"{layer}_[0-9]*.{suffix}")}
    return dict(sorted(found.items()))


def _resolution(scene: dict[str, Any], image: Path) -> tuple[int, int]:
    """Return height and width: of ``resolution`` (width first), of older files' own keys, or of the first image."""
    if "resolution" in scene:
        width, height = scene["resolution"]
    elif "width" in scene and "height" in scene:
        width, height = scene["width"], scene["height"]
    else:
        height, width = image_size(image)
    return int(height), int(width)
