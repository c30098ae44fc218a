"""What a hand takes hold of in the 3D scene: a hull around each body, and a gizmo at what is selected."""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from vpd_lightning.editing.selectors import Cluster
from vpd_lightning.viewer.panes import SELECTED
from vpd_lightning.viewer.tab_host import TabHost

_DRAGGED = 0.4  # opacity


Select = Callable[[int | None], None]
Move = Callable[[list[float], tuple[float, ...], list[float]], None]


class BodyHandles:
    """Hulls that can be clicked and dragged, and the gizmo; what is dragged moves when it is let go.

    ``select`` gets the number of a body; ``move`` a shift (metres), a turn (w, x, y, z) and the point to turn about,
    and moves what is selected.
    """

    def __init__(self, panel: TabHost, select: Select, move: Move):
        self.panel, self.session, self._select, self._move = panel, panel.session, select, move
        self._hulls: list[Any] | None = None  # made where they are shown for the first time
        self._gizmo: Any = None
        self._visible = False

    def renew(self) -> None:
        """Forget the hulls: the scene was edited."""
        for handle in self._hulls or ():
            if handle is not None:
                handle.remove()
        self._hulls = None

    def show(self, visible: bool) -> None:
        """Show the handles of the edited scene's bodies, or hide them."""
        self._visible = visible
        if visible and self._hulls is None:
            self._hulls = [self._hull(number) for number in range(len(self.session.cluster_sizes()))]
        for handle in (*(self._hulls or ()), self._gizmo):
            if handle is not None and handle.visible != visible:
                handle.visible = visible

    def show_selected(self) -> None:
        """Put the gizmo at what is selected."""
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        body, chosen = self.session.selected_body, self.session.selected
        if not bool(chosen.any()):
            return
        points = self._points(chosen.cpu().numpy())
        size = max(float(np.linalg.norm(np.ptp(points, axis=0))), 0.05)
        center = points.mean(axis=0)
        self._gizmo = self.panel.client.scene.add_transform_controls(
            "/gizmo", scale=0.7 * size, depth_test=False, position=center, visible=self._visible
        )
        hull = self._hulls[body] if self._hulls and body is not None and body < len(self._hulls) else None

        async def turned(event: Any) -> None:
            gizmo = event.target
            if hull is not None:
                hull.position, hull.wxyz, hull.opacity = gizmo.position, gizmo.wxyz, _DRAGGED
            if event.phase == "end":
                turn = tuple(float(value) for value in gizmo.wxyz)
                self._later(lambda: self._move((np.asarray(gizmo.position) - center).tolist(), turn, center.tolist()))

        self._gizmo.on_update(turned)

    def _later(self, action: Callable[[], Any]) -> None:
        """Edit on another thread than that which carries the browser's messages."""
        threading.Thread(target=self.panel.act, args=(action,), daemon=True, name="vpd-view edit").start()

    def _points(self, chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
        return self.session.now.states[0].positions[0].double().cpu().numpy()[chosen]

    def _hull(self, number: int) -> Any:
        points = self._points(self.session.now.editor.select(Cluster(number)).cpu().numpy())
        center = points.mean(axis=0)
        try:
            faces = ConvexHull(points).simplices
        except QhullError:  # flat, or too few particles
            return None
        handle = self.panel.client.scene.add_mesh_simple(
            f"/bodies/{number}",
            (points - center).astype(np.float32),
            faces.astype(np.uint32),
            color=SELECTED,
            opacity=0.0,
            side="double",
            position=center,
            visible=self._visible,
            cast_shadow=False,
            receive_shadow=False,
        )
        grabbed = [center]

        async def drag(event: Any) -> None:  # viser keeps the order of phases for what is async
            if event.phase == "start":
                grabbed[0] = np.asarray(event.start_position)
            shift = np.asarray(event.end_position) - grabbed[0]
            handle.position, handle.opacity = center + shift, _DRAGGED
            if event.phase == "end":
                self._later(lambda: self._dropped(number, shift.tolist(), center.tolist()))

        handle.on_click(lambda _: self.panel.act(lambda: self._select(number)))
        handle.on_drag("left")(drag)
        return handle

    def _dropped(self, number: int, shift: list[float], center: list[float]) -> None:
        self._select(number)
        self._move(shift, (1.0, 0.0, 0.0, 0.0), center)
