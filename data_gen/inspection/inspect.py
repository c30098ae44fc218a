"""What is in a data set: in words, as contact sheets, as a plan of the cameras, and as a point cloud."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_gen.inspection.camera_plot import draw_cameras
from data_gen.inspection.contact_sheet import mask_sheet, trajectory_sheet, view_sheet
from data_gen.inspection.pictures import write_figure, write_png
from data_gen.inspection.point_cloud import draw_points, merged_points
from vpd_lightning.data.ground_truth import has_state
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import DataError
from vpd_lightning.media.ply import write_ply

SHEET_NAME = "contact_sheet.png"
TRAJECTORIES_NAME, CAMERAS_NAME = "trajectories.png", "cameras.png"
POINTS_NAME, POINTS_PICTURE_NAME = "points.ply", "points.png"
MASK_NAME = "may_move.png"


def draw_mask(path: Path, out: Path | None, times: Sequence[int], mask: NDArray[np.bool_]) -> Path:
    """Draw frames (down) by views (across) of a trajectory file, a mask in red; return the path of the PNG.

    ``out`` is as in ``inspect_dataset``.
    """
    target = path.parent if out is None else out.parent if out.suffix.lower() == ".png" else out
    return write_png(target / MASK_NAME, mask_sheet(path, times, mask))


def inspect_dataset(path: str | Path, out: Path | None = None) -> list[Path]:
    """Draw everything there is to see of a data set folder or one trajectory file; return the files written.

    A contact sheet of the first trajectory, one of the trajectories (of a folder), a plan of the cameras, and the
    merged point cloud of the middle frame inside the workspace as PLY and as a picture. ``out`` is a folder, or the
    ``.png`` path of the contact sheet, beside which the rest goes; by default the data set's own folder.
    """
    path = Path(path)
    written = [draw_contact_sheet(path, out)]
    folder = written[0].parent
    files = files_of(path)
    if path.is_dir():
        written.append(write_png(folder / TRAJECTORIES_NAME, trajectory_sheet(files)))
    with TrajectoryReader(files[0]) as reader:
        written.append(write_figure(folder / CAMERAS_NAME, draw_cameras(reader)))
        positions, colors = merged_points(reader, reader.num_frames // 2)
    write_ply(folder / POINTS_NAME, positions, colors)
    return [
        *written,
        folder / POINTS_NAME,
        write_figure(folder / POINTS_PICTURE_NAME, draw_points(positions, colors)),
    ]


def draw_contact_sheet(path: str | Path, out: Path | None = None) -> Path:
    """Draw frames (down) by views (across) of the first trajectory, and the depth of view 0; return the PNG's path.

    ``out`` is a folder or a ``.png`` path; by default the data set's own folder. The picture is overwritten.
    """
    path = Path(path)
    target = out if out is not None else path.parent if path.is_file() else path
    if target.suffix.lower() != ".png":
        target = target / SHEET_NAME
    return write_png(target, view_sheet(files_of(path)[0]))


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
        path = files_of(path)[0]
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
            *([f"views          {', '.join(reader.view_names)}"] if reader.view_names else []),
            f"depth          {extent}, {measured.size / depth.size:.1%} of the pixels of the first frame",
            f"workspace      {_vector(reader.workspace_min)} to {_vector(reader.workspace_max)} m, "
            f"near {reader.near:g}, far {reader.far:g} m",
            f"ground truth   {'yes' if has_state(path) else 'no'}",
        ]
    return "\n".join(lines)


def files_of(path: Path) -> list[Path]:
    """Return the trajectory files of a data set folder, or the one file that the path is."""
    if path.is_file():
        return [path]
    files = [file for members in load_manifest(path).splits.values() for file in members]
    if not files:
        raise DataError(f"{path} has no trajectories.")
    return files


def _vector(values: tuple[float, float, float]) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"
