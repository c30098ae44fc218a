"""The HDF5 file of one trajectory: names, shapes, dtypes, and an atomic writer.

Schema version 1, or 2 with ``action/``: files without actions are the same in both.

Readable with h5py alone::

    rgb          (time, view, height, width, 3) uint8      sRGB
    depth        (time, view, height, width)    float32    z-depth in metres, 0 = no measurement
                                                (or uint16 with attributes ``scale`` and ``offset``)
    intrinsics   (view, 3, 3) or (time, view, 3, 3) float64    pixels, pixel centres at +0.5
    cam_to_world (view, 4, 4) or (time, view, 4, 4) float64    OpenCV camera axes, metres
    action/      optional motion that is given, such as a robot's (see ``data.driven``)
    state/       optional ground truth, for evaluation only (see ``data.ground_truth``)
    attributes   schema_version, frame_time (s), near, far (m along the ray), workspace_min, workspace_max (m),
                 depth_type = "z", source_depth_type, seed, engine, scene_hash; recordings: view_names (a JSON list)
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from vpd_lightning.files import AtomicPath

SCHEMA_VERSION = 1
SCHEMA_VERSION_WITH_ACTION = 2
SCHEMA_VERSIONS = (SCHEMA_VERSION, SCHEMA_VERSION_WITH_ACTION)  # that can be read
DEPTH_TYPE = "z"
RGB, DEPTH, INTRINSICS, CAM_TO_WORLD, STATE = "rgb", "depth", "intrinsics", "cam_to_world", "state"
VIEW_NAMES = "view_names"
ACTION = "action"
ACTION_POINTS = "points"  # (time, particle, 3) float32 m, world: on the surface of what is driven, the same ones always
ACTION_NORMALS = "normals"  # (time, particle, 3) float32, world, outward, of unit length
ACTION_GROUPS = "groups"  # (particle,) int32, the rigid part (link) that each point belongs to, from 0
ACTION_POSES = "poses"  # optional (time, group, 4, 4) float64: part to world, as measured
ACTION_COMMANDED_POSES = "commanded_poses"  # optional, the same: where the controller was asked to bring it
STATE_POSITIONS = "positions"  # (time, object, 3) m, world
STATE_QUATERNIONS = "quaternions"  # (time, object, 4) w x y z, body to world
STATE_LINEAR_VELOCITIES = "linear_velocities"  # (time, object, 3) m/s, world, of the centre of mass
STATE_ANGULAR_VELOCITIES = "angular_velocities"  # (time, object, 3) rad/s, world
STATE_HALF_SIZES = "half_sizes"  # (object, 3) m, along the body's own axes
STATE_SEGMENTATION = "segmentation"  # (time, view, height, width) uint8, 0 background, i + 1 object i, 255 driven
DRIVEN_LABEL = 255
STATE_DEPTH = "depth"  # (time, view, height, width) float32 m: without the errors of a simulated sensor
STATE_CAM_TO_WORLD = "cam_to_world"  # (view, 4, 4) float64: as above
STATE_VERTICES = "vertices"  # (time, vertex, 3) float32 m, world: soft bodies, all of them one after another
STATE_VERTEX_OBJECTS = "vertex_objects"  # (vertex,) int32, the object each vertex belongs to
STATE_TETRAHEDRA = "tetrahedra"  # (element, 4) int32, indices into vertices
# gzip is the default because the same pictures give the same bytes. HDF5's lzf does not: its dictionary starts with
# whatever its memory held before, and it is read by HDF5, which takes a few times as long.
COMPRESSIONS = ("gzip", "lzf", "none")
_GZIP_LEVEL = 1  # level 4 takes 1.5 times as long to write and saves a sixth
DEPTH_ENCODINGS = ("float32", "uint16")
_UINT16_STEPS = 65534  # 0 means no measurement, 1..65535 cover [near, far of the data]


@dataclass(frozen=True)
class Trajectory:
    """Everything one file holds; ``ValueError`` for arrays without the shapes and dtypes of this module's table."""

    rgb: NDArray[Any]
    depth: NDArray[Any]
    intrinsics: NDArray[Any]
    cam_to_world: NDArray[Any]
    frame_time: float
    near: float
    far: float
    workspace_min: tuple[float, float, float]
    workspace_max: tuple[float, float, float]
    seed: int = 0
    source_depth_type: str = DEPTH_TYPE
    engine: str = ""
    scene_hash: str = ""
    state: Mapping[str, NDArray[Any]] | None = None
    action: Mapping[str, NDArray[Any]] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        time, view, height, width = self.depth.shape
        _require("rgb", self.rgb, np.uint8, [(time, view, height, width, 3)])
        _require("depth", self.depth, np.float32, [(time, view, height, width)])
        for name, size in ((INTRINSICS, 3), (CAM_TO_WORLD, 4)):
            _require(name, getattr(self, name), np.float64, [(view, size, size), (time, view, size, size)])


def _require(name: str, array: NDArray[Any], dtype: type, shapes: list[tuple[int, ...]]) -> None:
    if array.dtype != dtype or array.shape not in shapes:
        allowed = " or ".join(map(str, shapes))
        raise ValueError(f"{name} is {array.dtype} {array.shape}; it must be {np.dtype(dtype)} {allowed}")


def write_trajectory(
    path: Path, trajectory: Trajectory, *, compression: str = "gzip", depth_encoding: str = "float32"
) -> None:
    """Write one file so that ``path`` either does not exist or is complete, even after a power cut.

    The file is written under a temporary name in the same folder, flushed to disk, and renamed. One chunk is one image
    of one view, with a Fletcher-32 checksum. ``depth_encoding="uint16"`` stores depth in 65,534 equal steps between the
    smallest and largest measured depth (0.036 mm error over 0.3-5 m) in a fifth of the space.
    """
    if compression not in COMPRESSIONS:
        raise ValueError(f"compression is {compression!r}; allowed: {', '.join(COMPRESSIONS)}")
    if depth_encoding not in DEPTH_ENCODINGS:
        raise ValueError(f"depth_encoding is {depth_encoding!r}; allowed: {', '.join(DEPTH_ENCODINGS)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    with AtomicPath(path) as partial, h5py.File(partial, "w", libver=("v110", "v110")) as file:
        _write_attributes(file, trajectory)
        _write_images(file, RGB, trajectory.rgb, compression)
        if depth_encoding == "uint16":
            encoded, scale, offset = encode_depth(trajectory.depth)
            dataset = _write_images(file, DEPTH, encoded, compression)
            dataset.attrs["scale"], dataset.attrs["offset"] = scale, offset
        else:
            _write_images(file, DEPTH, trajectory.depth, compression)
        file.create_dataset(INTRINSICS, data=trajectory.intrinsics)
        file.create_dataset(CAM_TO_WORLD, data=trajectory.cam_to_world)
        if trajectory.action is not None:
            group = file.create_group(ACTION)
            for name, values in trajectory.action.items():
                group.create_dataset(name, data=values)
        if trajectory.state is not None:
            group = file.create_group(STATE)
            for name, values in trajectory.state.items():
                if name in (STATE_SEGMENTATION, STATE_DEPTH):
                    _write_images(group, name, values, compression)
                else:
                    group.create_dataset(name, data=values)


def encode_depth(depth: NDArray[np.float32]) -> tuple[NDArray[np.uint16], float, float]:
    """Quantise depth in metres to uint16; gives ``(codes, scale, offset)`` with ``depth = offset + scale * code``."""
    valid = np.isfinite(depth) & (depth > 0)
    if not valid.any():
        return np.zeros(depth.shape, np.uint16), 1.0, 0.0
    low, high = float(depth[valid].min()), float(depth[valid].max())
    scale = max(high - low, 1e-6) / _UINT16_STEPS
    offset = low - scale
    codes = np.zeros(depth.shape, np.uint16)
    codes[valid] = np.rint((depth[valid].astype(np.float64) - offset) / scale).astype(np.uint16)
    return codes, scale, offset


def decode_depth(codes: NDArray[np.uint16], scale: float, offset: float) -> NDArray[np.float32]:
    """Undo ``encode_depth``; code 0 gives 0 (no measurement)."""
    meters = (offset + scale * np.arange(2**16)).astype(np.float32)  # a table is four times as fast as computing
    meters[0] = 0.0
    return meters[codes]


def _write_attributes(file: h5py.File, trajectory: Trajectory) -> None:
    has_action = trajectory.action is not None
    file.attrs["schema_version"] = SCHEMA_VERSION_WITH_ACTION if has_action else SCHEMA_VERSION
    file.attrs["depth_type"] = DEPTH_TYPE
    for name in ("frame_time", "near", "far", "seed", "source_depth_type", "engine", "scene_hash"):
        file.attrs[name] = getattr(trajectory, name)
    file.attrs["workspace_min"] = np.asarray(trajectory.workspace_min, np.float64)
    file.attrs["workspace_max"] = np.asarray(trajectory.workspace_max, np.float64)
    for name, value in trajectory.attributes.items():
        file.attrs[name] = value


def _write_images(group: h5py.Group, name: str, images: NDArray[Any], compression: str) -> h5py.Dataset:
    return group.create_dataset(
        name,
        data=images,
        chunks=(1, 1, *images.shape[2:]),
        compression=None if compression == "none" else compression,
        compression_opts=_GZIP_LEVEL if compression == "gzip" else None,
        shuffle=images.dtype.itemsize > 1,
        fletcher32=True,
    )
