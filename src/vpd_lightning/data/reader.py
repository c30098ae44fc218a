"""Reading trajectories: lazily opened, checked before use, only the frames and views that a step needs."""

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data import schema
from vpd_lightning.data.camera_checks import check_intrinsics, check_poses
from vpd_lightning.data.hdf5.broken_file import refuse
from vpd_lightning.data.hdf5.checks import (
    checked_attribute,
    checked_dataset,
    checked_view_names,
    named_damage,
    open_file,
)
from vpd_lightning.data.hdf5.image_chunks import ImageChunks
from vpd_lightning.data.hdf5.stored_chunks import read_whole

MAX_IMAGE_SIDE = 16384
MAX_FRAMES = 1_000_000
MAX_VIEWS = 4096
MAX_COORDINATE = 1e6  # metres

Indices = Sequence[int] | NDArray[np.integer] | None


class TrajectoryReader:
    """One file; opened and checked at the first use in each process, so that it can be sent to loader workers.

    It reads pixels and cameras only. Ground-truth state is out of its reach (see ``data.ground_truth``).

    Raises:
        DataError: at the first use, naming the file, its fault and the way out.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._file: h5py.File | None = None
        self._chunks: dict[str, ImageChunks] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path}  # handles must not cross a process border

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["path"])  # type: ignore[misc]

    def __enter__(self) -> "TrajectoryReader":
        self._open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; the next use opens it again."""
        if self._file is not None:
            self._chunks = {}
            self._file.close()
            self._file = None

    # -- what is in it -------------------------------------------------------------------------------------------------

    @property
    def num_frames(self) -> int:
        return self._attributes()["shape"][0]

    @property
    def num_views(self) -> int:
        return self._attributes()["shape"][1]

    @property
    def height(self) -> int:
        return self._attributes()["shape"][2]

    @property
    def width(self) -> int:
        return self._attributes()["shape"][3]

    @property
    def frame_time(self) -> float:
        """Seconds from one frame to the next."""
        return self._attributes()["frame_time"]

    @property
    def near(self) -> float:
        """Metres along a ray before which nothing is."""
        return self._attributes()["near"]

    @property
    def far(self) -> float:
        """Metres along a ray beyond which nothing is of interest."""
        return self._attributes()["far"]

    @property
    def workspace_min(self) -> tuple[float, float, float]:
        return self._attributes()["workspace_min"]

    @property
    def workspace_max(self) -> tuple[float, float, float]:
        return self._attributes()["workspace_max"]

    @property
    def scene_hash(self) -> str:
        """What the file was made from (see ``data_gen``); empty for recordings."""
        return self._attributes()["scene_hash"]

    @property
    def view_names(self) -> tuple[str, ...]:
        """What the source of a recording calls its views; empty where it has no names."""
        return self._attributes()["view_names"]

    def view_label(self, view: int) -> str:
        """Return a view's number, and its name where it has one."""
        return f"{view} ({self.view_names[view]})" if self.view_names else str(view)

    # -- reading -------------------------------------------------------------------------------------------------------

    def rgb(self, times: Indices = None, views: Indices = None) -> NDArray[np.uint8]:
        """Return images (time, view, height, width, 3), uint8 sRGB; ``None`` means all frames or all views."""
        return self._images(schema.RGB, times, views)

    def depth(self, times: Indices = None, views: Indices = None) -> NDArray[np.float32]:
        """Return z-depth (time, view, height, width) in metres; 0 where there is no measurement."""
        depth = self._images(schema.DEPTH, times, views)
        if depth.dtype == np.uint16:
            attributes = self._attributes()
            depth = schema.decode_depth(depth, attributes["scale"], attributes["offset"])
        if not depth.size or (depth.min() >= 0 and depth.max() < np.inf):  # false for NaN; faster than looking at all
            return depth
        depth[~np.isfinite(depth)] = 0.0
        if (depth < 0).any():
            raise refuse(self.path, "negative_depth", "'depth' has negative values; 0 means no measurement")
        return depth

    def cameras(self, times: Indices = None, views: Indices = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return intrinsics (time, view, 3, 3) in pixels and cam_to_world (time, view, 4, 4), OpenCV axes, metres."""
        self._open()
        chosen_times = self._indices(times, self.num_frames, "frame")
        chosen_views = self._indices(views, self.num_views, "view")
        intrinsics, cam_to_world = self._cameras
        if intrinsics.ndim == 3:
            intrinsics = np.broadcast_to(intrinsics, (self.num_frames, *intrinsics.shape))
        if cam_to_world.ndim == 3:
            cam_to_world = np.broadcast_to(cam_to_world, (self.num_frames, *cam_to_world.shape))
        grid = np.ix_(chosen_times, chosen_views)
        return intrinsics[grid].copy(), cam_to_world[grid].copy()

    @property
    def is_static_cameras(self) -> bool:
        """Whether the cameras stay where they are throughout the recording."""
        self._open()
        return all(array.ndim == 3 or bool((array == array[:1]).all()) for array in self._cameras)

    def _images(self, name: str, times: Indices, views: Indices) -> NDArray[Any]:
        self._open()
        chosen_times = self._indices(times, self.num_frames, "frame")
        chosen_views = self._indices(views, self.num_views, "view")
        return self._chunks[name].read(chosen_times, chosen_views)

    def _indices(self, wanted: Indices, count: int, what: str) -> NDArray[np.int64]:
        if wanted is None:
            return np.arange(count)
        indices = np.asarray(wanted, dtype=np.int64).reshape(-1)
        if indices.size and (indices.min() < 0 or indices.max() >= count):
            worst = int(indices.max() if indices.max() >= count else indices.min())
            raise refuse(
                self.path,
                "not_that_many",
                f"{what} {worst} was asked for; it has {count} {what}s (0 to {count - 1})",
                f"Ask for fewer {what}s in the configuration, or use a data set that has them.",
            )
        return indices

    # -- opening -------------------------------------------------------------------------------------------------------

    def _open(self) -> h5py.File:
        if self._file is None:
            file = open_file(self.path)
            try:
                with named_damage(self.path):
                    self._check(file)
            except BaseException:
                file.close()
                raise
            self._file = file
        return self._file

    def _attributes(self) -> dict[str, Any]:
        self._open()
        return self._values

    def _check(self, file: h5py.File) -> None:
        path = self.path
        version = checked_attribute(path, file, "schema_version", "integer")
        if version not in schema.SCHEMA_VERSIONS:
            known = " and ".join(map(str, schema.SCHEMA_VERSIONS))
            raise refuse(
                path,
                "schema_version",
                f"has schema version {version}; this program reads versions {known}",
            )
        depth_type = checked_attribute(path, file, "depth_type", "text")
        if depth_type != schema.DEPTH_TYPE:
            raise refuse(
                path, "depth_type", f"has depth_type {depth_type!r}; depth must be 'z', along the optical axis"
            )
        values: dict[str, Any] = {}
        for key in ("frame_time", "near", "far"):
            values[key] = checked_attribute(path, file, key, "number")
        for key in ("workspace_min", "workspace_max"):
            values[key] = checked_attribute(path, file, key, "number", length=3)
        values["scene_hash"] = checked_attribute(path, file, "scene_hash", "text") if "scene_hash" in file.attrs else ""
        if values["frame_time"] <= 0:
            raise refuse(path, "frame_time", f"has frame_time {values['frame_time']}; it must be positive (seconds)")
        if not 0 <= values["near"] < values["far"]:
            raise refuse(
                path, "near_far", f"has near {values['near']} and far {values['far']}; 0 <= near < far is needed"
            )
        if not all(abs(value) <= MAX_COORDINATE for key in ("workspace_min", "workspace_max") for value in values[key]):
            raise refuse(path, "workspace", f"has a workspace beyond {MAX_COORDINATE:g} m")
        if not all(low < high for low, high in zip(values["workspace_min"], values["workspace_max"], strict=True)):
            raise refuse(path, "workspace", "has an empty workspace (workspace_min is not below workspace_max)")

        rgb = checked_dataset(path, file, schema.RGB, dtypes=[np.uint8], num_axes=[5])
        depth = checked_dataset(path, file, schema.DEPTH, dtypes=[np.float32, np.uint16], num_axes=[4])
        time, view, height, width, channels = rgb.shape
        if channels != 3:
            raise refuse(path, "wrong_shape", f"'rgb' has {channels} channels; it must have 3")
        if depth.shape != rgb.shape[:4]:
            raise refuse(path, "wrong_shape", f"'depth' has shape {depth.shape}; 'rgb' has {rgb.shape}")
        if time > MAX_FRAMES or view > MAX_VIEWS or max(height, width) > MAX_IMAGE_SIDE:
            limit = f"{MAX_FRAMES} frames, {MAX_VIEWS} views, {MAX_IMAGE_SIDE} pixels"
            raise refuse(path, "absurd_size", f"'rgb' has shape {rgb.shape}, over the limits ({limit})")
        if depth.dtype == np.uint16:
            for key in ("scale", "offset"):
                values[key] = checked_attribute(path, depth, key, "number")
            if values["scale"] <= 0:
                raise refuse(path, "depth_scale", f"'depth' has scale {values['scale']}; it must be positive")
        values["view_names"] = checked_view_names(path, file, view)
        self._values = {**values, "shape": (time, view, height, width)}
        self._chunks = {schema.RGB: ImageChunks(path, rgb), schema.DEPTH: ImageChunks(path, depth)}
        self._cameras = (
            check_intrinsics(path, self._read_matrices(file, schema.INTRINSICS, time, view, 3), height, width),
            check_poses(path, self._read_matrices(file, schema.CAM_TO_WORLD, time, view, 4)),
        )

    def _read_matrices(self, file: h5py.File, name: str, time: int, view: int, size: int) -> NDArray[np.float64]:
        dataset = checked_dataset(self.path, file, name, dtypes=[np.float64], num_axes=[3, 4])
        shapes = [(view, size, size), (time, view, size, size)]
        if dataset.shape not in shapes:
            raise refuse(
                self.path, "wrong_shape", f"{name!r} has shape {dataset.shape}; it must be {shapes[0]} or {shapes[1]}"
            )
        return read_whole(self.path, dataset)


class ReaderCache:
    """Keeps the readers used last open; one per process (a copy sent to another process starts empty)."""

    def __init__(self, capacity: int) -> None:
        if capacity < 1:
            raise ValueError(f"capacity is {capacity}; at least 1 is needed")
        self.capacity = capacity
        self._readers: OrderedDict[Path, TrajectoryReader] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        return {"capacity": self.capacity}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["capacity"])  # type: ignore[misc]

    def get(self, path: str | Path) -> TrajectoryReader:
        """Return the reader of a file, closing the one that was used longest ago when there are too many."""
        key = Path(path)
        reader = self._readers.pop(key, None) or TrajectoryReader(key)
        self._readers[key] = reader
        while len(self._readers) > self.capacity:
            self._readers.popitem(last=False)[1].close()
        return reader

    def close(self) -> None:
        """Close all readers."""
        for reader in self._readers.values():
            reader.close()
        self._readers.clear()
