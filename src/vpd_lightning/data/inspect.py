"""What is in a data set, in words and as a contact sheet."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.ground_truth import has_state
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.schema import AtomicPath
from vpd_lightning.errors import DataError

SHEET_NAME = "contact_sheet.png"
_MAX_ROWS, _MAX_VIEWS, _MIN_SIDE = 8, 8, 96
_GAP = 2


def describe(path: str | Path) -> str:
    """Return a summary of a data set folder or one trajectory file."""
    path = Path(path)
    lines = []
    if path.is_dir():
        manifest = load_manifest(path)
        counts = ", ".join(f"{name} {len(files)}" for name, files in manifest.splits.items())
        lines += [
            f"{manifest.name}: scene {manifest.scene}, preset {manifest.preset}, seed {manifest.seed}",
            f"trajectories   {counts}; {sum(manifest.num_bytes.values()) / 2**20:.1f} MiB",
            f"made by        {manifest.generator}; " + ", ".join(f"{k} {v}" for k, v in manifest.versions.items()),
            f"licence        {manifest.license}",
            f"data SHA-256   {manifest.digest}",
        ]
        path = _first_file(path)
    with TrajectoryReader(path) as reader:
        intrinsics, cam_to_world = reader.cameras([0])
        depth = reader.depth([0])
        measured = depth[depth > 0]
        extent = f"{measured.min():.2f} to {measured.max():.2f} m" if measured.size else "none measured"
        field_of_view = 2 * np.degrees(np.arctan(0.5 * reader.height / intrinsics[0, :, 1, 1]))
        heights = cam_to_world[0, :, 2, 3]
        lines += [
            f"each           {reader.num_frames} frames every {reader.frame_time:g} s, {reader.num_views} views of "
            f"{reader.width}x{reader.height}, {'fixed' if reader.is_static_cameras else 'moving'} cameras",
            f"cameras        {heights.min():.2f} to {heights.max():.2f} m high, vertical field of view "
            f"{field_of_view.min():.1f} to {field_of_view.max():.1f} degrees",
            f"depth          {extent}, {measured.size / depth.size:.1%} of the pixels of the first frame",
            f"workspace      {_vector(reader.workspace_min)} to {_vector(reader.workspace_max)} m, "
            f"near {reader.near:g}, far {reader.far:g} m",
            f"ground truth   {'yes' if has_state(path) else 'no'}",
        ]
    return "\n".join(lines)


def draw_contact_sheet(path: str | Path, out: Path | None = None) -> Path:
    """Draw frames (down) by views (across) of the first trajectory, and the depth of view 0; return the PNG's path.

    ``out`` is a folder or a ``.png`` path; by default the data set's own folder. The picture is overwritten.
    """
    import cv2

    path = Path(path)
    file = _first_file(path) if path.is_dir() else path
    target = out if out is not None else file.parent if path.is_file() else path
    if target.suffix.lower() != ".png":
        target = target / SHEET_NAME
    with TrajectoryReader(file) as reader:
        times = np.unique(np.linspace(0, reader.num_frames - 1, _MAX_ROWS).round().astype(int))
        views = np.arange(min(reader.num_views, _MAX_VIEWS))
        rgb, depth = reader.rgb(times, views), reader.depth(times, [0])
    scale = max(1, -(-_MIN_SIDE // min(rgb.shape[2:4])))
    tiles = np.concatenate([rgb, color_depth(depth)], axis=1).repeat(scale, axis=2).repeat(scale, axis=3)
    tiles = np.pad(tiles, ((0, 0), (0, 0), (0, _GAP), (0, _GAP), (0, 0)), constant_values=255)
    rows, columns, height, width, _ = tiles.shape
    sheet = tiles.transpose(0, 2, 1, 3, 4).reshape(rows * height, columns * width, 3)
    is_encoded, encoded = cv2.imencode(".png", np.ascontiguousarray(sheet[..., ::-1]))
    if not is_encoded:
        raise DataError(f"The contact sheet of {file} cannot be encoded as PNG.")
    target.parent.mkdir(parents=True, exist_ok=True)
    with AtomicPath(target) as partial:
        partial.write_bytes(encoded.tobytes())
    return target


def color_depth(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return depth as grey (..., 3) uint8: near is light, far is dark, black is not measured."""
    valid = depth > 0
    if not valid.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    low, high = np.percentile(depth[valid], [1, 99])
    share = np.clip((depth - low) / max(high - low, 1e-6), 0, 1)
    grey = np.where(valid, 255 - 215 * share, 0).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def _first_file(folder: Path) -> Path:
    for files in load_manifest(folder).splits.values():
        if files:
            return files[0]
    raise DataError(f"{folder} has no trajectories.")


def _vector(values: tuple[float, float, float]) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"
