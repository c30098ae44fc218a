"""Where the cameras stand and look: frusta, workspace and floor, from above and from the side."""

from typing import TYPE_CHECKING, Any

import numpy as np

from data_gen.inspection.posed_depth import Array
from vpd_lightning.data.reader import TrajectoryReader

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MAX_LABELS = 24
_PANELS = {"from above": (0, 1), "from the front": (0, 2)}  # which world axes go right and up
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]


def draw_cameras(reader: TrajectoryReader) -> "Figure":
    """Draw the cameras of the first frame as pyramids, and the path of those that move (world frame, metres)."""
    from matplotlib.figure import Figure

    intrinsics, cam_to_world = reader.cameras()
    box = _box(np.array(reader.workspace_min), np.array(reader.workspace_max))
    centers = cam_to_world[..., :3, 3]
    everything = np.concatenate([box, centers.reshape(-1, 3)])
    reach = float(np.ptp(everything, axis=0).max())
    colors = [f"C{view % 10}" for view in range(reader.num_views)]
    figure = Figure(figsize=(12, 6), layout="constrained")
    for panel, (title, (right, up)) in zip(figure.subplots(1, 2), _PANELS.items(), strict=True):
        _draw_floor(panel, everything, right, up)
        for first, second in _EDGES:
            panel.plot(box[[first, second], right], box[[first, second], up], color="#666666", linewidth=1.2)
        for view, color in enumerate(colors):
            corners = frustum(
                intrinsics[0, view], cam_to_world[0, view], reader.height, reader.width, length=0.12 * reach
            )
            center = centers[0, view]
            for index, corner in enumerate(corners):
                following = corners[(index + 1) % 4]
                for start, end in ((center, corner), (corner, following)):
                    panel.plot([start[right], end[right]], [start[up], end[up]], color=color, linewidth=1)
            if not reader.is_static_cameras:
                panel.plot(centers[:, view, right], centers[:, view, up], color=color, linewidth=0.8, alpha=0.6)
            if reader.num_views <= _MAX_LABELS:
                panel.annotate(reader.view_label(view), (center[right], center[up]), color=color, fontsize=9)
        panel.set_title(title)
        panel.set_xlabel("xyz"[right] + " (m)")
        panel.set_ylabel("xyz"[up] + " (m)")
        panel.set_aspect("equal")
    kind = "fixed" if reader.is_static_cameras else "moving"
    figure.suptitle(f"{reader.num_views} {kind} cameras; grey: workspace; green: floor z = 0")
    return figure


def frustum(intrinsics: Array, cam_to_world: Array, height: int, width: int, length: float) -> Array:
    """Return the image's corners (4, 3) in the world, ``length`` metres before the camera along its axis."""
    pixels = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], np.float64)
    corners = length * pixels @ np.linalg.inv(intrinsics).T
    return corners @ cam_to_world[:3, :3].T + cam_to_world[:3, 3]


def _draw_floor(panel: Any, everything: Array, right: int, up: int) -> None:
    low, high = everything.min(axis=0), everything.max(axis=0)
    if up == 2:
        panel.axhline(0.0, color="#2e7d32", linewidth=1)
        return
    step = 10.0 ** np.floor(np.log10(max(float((high - low)[:2].max()), 1e-6)))
    for axis, draw in ((right, panel.axvline), (up, panel.axhline)):
        for level in np.arange(np.floor(low[axis] / step), np.ceil(high[axis] / step) + 1) * step:
            draw(level, color="#2e7d32", linewidth=0.5, alpha=0.35)


def _box(low: Array, high: Array) -> Array:
    """The eight corners; those whose numbers differ in one bit share an edge."""
    return np.array([[(low, high)[(corner >> axis) & 1][axis] for axis in range(3)] for corner in range(8)])
