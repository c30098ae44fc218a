"""What all cameras together measure at one time, as coloured points."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from data_gen.inspection.posed_depth import Array, rays
from vpd_lightning.data.reader import TrajectoryReader

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PICTURE_SIDE = 560  # pixels
_SPLATS = (2, 8)  # pixels that a point covers, at least and at most: about what its neighbours leave free
_DIRECTIONS = {  # from where: azimuth and elevation in degrees
    "from above": (-90.0, 90.0),
    "from the side": (-90.0, 20.0),
}


def merged_points(reader: TrajectoryReader, time: int = 0) -> tuple[Array, NDArray[np.uint8]]:
    """Return positions (point, 3) in metres, world frame, and colours (point, 3) of one frame from all views.

    Only points in the workspace; all of them where none is inside.
    """
    positions, colors = [], []
    intrinsics, cam_to_world = (part[0] for part in reader.cameras([time]))
    for view in range(reader.num_views):
        depth, rgb = reader.depth([time], [view])[0, 0], reader.rgb([time], [view])[0, 0]
        rows, columns = np.nonzero(depth > 0)
        points = rays(intrinsics[view], columns, rows) * depth[rows, columns].astype(np.float64)[:, None]
        positions.append(points @ cam_to_world[view, :3, :3].T + cam_to_world[view, :3, 3])
        colors.append(rgb[rows, columns])
    points, shades = np.concatenate(positions), np.concatenate(colors)
    is_inside = ((points >= reader.workspace_min) & (points <= reader.workspace_max)).all(axis=-1)
    return (points[is_inside], shades[is_inside]) if is_inside.any() else (points, shades)


def draw_points(positions: Array, colors: NDArray[np.uint8]) -> "Figure":
    """Draw points from above and from the side, without perspective; the nearer point hides the farther one."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5.6), layout="constrained")
    for axis, (title, (azimuth, elevation)) in zip(figure.subplots(1, 2), _DIRECTIONS.items(), strict=True):
        picture, extent = splat(positions, colors, azimuth, elevation)
        axis.imshow(picture, extent=extent, interpolation="nearest")
        axis.set_title(f"{title}, {len(positions)} points")
        axis.set_xlabel("x (m)")
        axis.set_ylabel("y (m)" if elevation == 90 else "up in the picture (m)")
    return figure


def splat(
    positions: Array, colors: NDArray[np.uint8], azimuth: float, elevation: float
) -> tuple[NDArray[np.uint8], tuple[float, float, float, float]]:
    """Return a picture (side, side, 3) seen from the given angles (degrees), white where there is no point.

    Also its extent in metres: left, right, bottom, top.
    """
    picture = np.full((_PICTURE_SIDE, _PICTURE_SIDE, 3), 255, np.uint8)
    if not len(positions):
        return picture, (-1.0, 1.0, -1.0, 1.0)
    turn, tilt = np.radians(azimuth), np.radians(elevation)
    toward = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
    right = np.array([-np.sin(turn), np.cos(turn), 0.0])
    across, up = positions @ right, positions @ np.cross(toward, right)
    low, high = np.array([across.min(), up.min()]), np.array([across.max(), up.max()])
    half = 0.52 * max(float((high - low).max()), 1e-6)
    left, bottom = 0.5 * (low + high) - half
    cell = 2 * half / _PICTURE_SIDE
    order = np.argsort(positions @ toward, kind="stable")  # far to near: the last to be painted stays
    columns = ((across[order] - left) / cell).astype(np.int64)
    rows = _PICTURE_SIDE - 1 - ((up[order] - bottom) / cell).astype(np.int64)
    splat_side = int(np.clip(np.ceil(0.8 * _PICTURE_SIDE / np.sqrt(len(positions))), *_SPLATS))
    side = _PICTURE_SIDE + splat_side
    squares = [(down, along) for down in range(splat_side) for along in range(splat_side)]
    cells = np.stack([(rows + down) * side + columns + along for down, along in squares], axis=1)
    canvas = np.full((side**2, 3), 255, np.uint8)
    canvas[cells.ravel()] = colors[order].repeat(len(squares), axis=0)
    picture = canvas.reshape(side, side, 3)[:_PICTURE_SIDE, :_PICTURE_SIDE]
    return picture, (left, left + 2 * half, bottom, bottom + 2 * half)
