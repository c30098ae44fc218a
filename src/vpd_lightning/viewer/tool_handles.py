"""What a hand takes hold of to act: a gizmo at the end of the tool's path, and a ball where a body should be."""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.types import Driven
from vpd_lightning.viewer.tab_host import TabHost

_PATH_COLOR, _GOAL_COLOR = (230, 120, 30), (40, 170, 90)
_LEAST_SIZE = 0.05  # metres

Moved = Callable[[NDArray[np.float64]], None]


class ToolHandles:
    """The tool's gizmo, its path, and the goal; ``stopped`` and ``goal_moved`` get x and y (2,) where one is let go."""

    def __init__(self, panel: TabHost, stopped: Moved, goal_moved: Moved):
        self.panel, self._stopped, self._goal_moved = panel, stopped, goal_moved
        self.goal: NDArray[np.float64] | None = None
        self._handles: dict[str, Any] = {}
        self._visible = False

    def renew(self) -> None:
        """Forget the gizmo and the path: the tool moves otherwise."""
        for name in ("tool", "path"):
            self._remove(name)

    def show(self, visible: bool, driven: Driven, motion: Driven | None, step: int) -> None:
        """Show what can be dragged, or hide it; draw the tool's way from ``step`` on (``motion`` None: do not)."""
        self._visible = visible
        points = driven.positions[0][driven.mask[0]].double().cpu().numpy()
        way = points.mean(axis=0)[None]
        if motion is not None:
            there = motion.mask[0]
            way = np.concatenate([way, motion.positions[:, there].double().mean(dim=1).cpu().numpy()])
        self._draw_path(way[step:])
        if visible and "tool" not in self._handles:
            size = max(float(np.linalg.norm(np.ptp(points, axis=0))), _LEAST_SIZE)
            self._handles["tool"] = self._gizmo("/act/tool", way[-1], size, self._stopped)
        for name in ("tool", "goal", "ball"):
            if name in self._handles:
                self._handles[name].visible = visible

    def put_goal(self, place: NDArray[np.float64]) -> None:
        """Put the goal at a place (3,), where it can be dragged."""
        self.goal = place.copy()
        scene = self.panel.client.scene
        self._handles["ball"] = scene.add_icosphere(
            "/act/ball", radius=0.6 * _LEAST_SIZE, color=_GOAL_COLOR, opacity=0.6, position=place, cast_shadow=False
        )

        def moved(to: NDArray[np.float64]) -> None:
            self.goal = np.array([*to, place[2]])
            self._goal_moved(to)

        self._handles["goal"] = self._gizmo("/act/goal", place, 2 * _LEAST_SIZE, moved, self._handles["ball"])

    def _draw_path(self, way: NDArray[np.float64]) -> None:
        self._remove("path")
        if len(way) < 2:
            return
        segments = np.stack([way[:-1], way[1:]], axis=1).astype(np.float32)
        self._handles["path"] = self.panel.client.scene.add_line_segments(
            "/act/path", segments, _PATH_COLOR, thickness=3.0, thickness_units="screen"
        )

    def _gizmo(self, name: str, place: NDArray[np.float64], size: float, done: Moved, along: Any = None) -> Any:
        gizmo = self.panel.client.scene.add_transform_controls(
            name,
            scale=0.7 * size,
            active_axes=(True, True, False),
            disable_rotations=True,
            depth_test=False,
            position=place,
            visible=self._visible,
        )

        async def dragged(event: Any) -> None:  # viser keeps the order of phases for what is async
            if along is not None:
                along.position = event.target.position
            if event.phase == "end":
                to = np.asarray(event.target.position, float)[:2]
                self._later(lambda: done(to))

        gizmo.on_update(dragged)
        return gizmo

    def _later(self, action: Callable[[], Any]) -> None:
        """Act on another thread than that which carries the browser's messages."""
        threading.Thread(target=self.panel.act, args=(action,), daemon=True, name="vpd-view act").start()

    def _remove(self, name: str) -> None:
        handle = self._handles.pop(name, None)
        if handle is not None:
            handle.remove()
