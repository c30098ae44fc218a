"""The tab that selects and edits."""

from typing import Any

import numpy as np

from vpd_lightning.editing.edit_files import load_edit
from vpd_lightning.editing.operations import Delete, Duplicate, Move, Scale, SetVelocity
from vpd_lightning.editing.selectors import Cluster, Color, Everything, Lasso, Selector
from vpd_lightning.viewer.session import COMBINATIONS
from vpd_lightning.viewer.tab_host import TabHost

_BESIDE = 0.3  # of the workspace's width: where a copy appears


class EditTab:
    """Selection by cluster, rectangle and colour; a gizmo that moves what is selected; edits, undo and comparison."""

    def __init__(self, panel: TabHost):
        self.panel, self.session = panel, panel.session
        gui: Any = panel.client.gui
        self.status = gui.add_markdown("")
        self.how = gui.add_dropdown("a new selection will", COMBINATIONS, initial_value="replace")
        self.clusters = gui.add_dropdown("cluster", ("-",), initial_value="-")
        self._button("Select cluster", self._select_cluster)
        self.rectangle = gui.add_checkbox("drag rectangles", False, hint="while on, dragging selects")
        with gui.add_folder("more ways to select", expand_by_default=False):
            self.color = gui.add_rgb("colour", (200, 60, 60))
            self.tolerance = gui.add_slider("tolerance", 0.02, 0.6, 0.02, 0.2)
            self._button("Select colour", self._select_color)
            self._button("Select all", lambda: self._select(Everything()))
            self._button("Select none", lambda: self._select(None))
        self._button("Delete", lambda: self._apply(Delete(self.session.need_selection())))
        self._button("Duplicate", self._duplicate)
        self._button("Move by gizmo", self._move)
        with gui.add_folder("velocity and size", expand_by_default=False):
            self.velocity = gui.add_vector3("velocity (m a step)", (0.0, 0.0, 0.0), step=0.01)
            self._button("Set velocity", self._set_velocity)
            self.factor = gui.add_number("scale", 1.5, min=0.05, max=20.0, step=0.05)
            self._button("Scale", lambda: self._apply(Scale(self.session.need_selection(), self.factor.value)))
        self._button("Undo", lambda: self._edit(self.session.undo))
        self._button("Redo", lambda: self._edit(self.session.redo))
        with gui.add_folder("compare", expand_by_default=False):
            self._button("Keep beside", self._keep)
            self._button("Swap with kept", lambda: self._edit(self.session.swap))
            self._button("Forget kept", self._forget)
        self.upload = gui.add_upload_button("Load edit (YAML)", mime_type=".yaml")
        self.upload.on_upload(lambda _: panel.act(self._load))
        self.rectangle.on_update(lambda _: panel.act(self._arm_rectangle))
        self._gizmo: Any = None
        self._preview: Any = None
        self._armed = False
        self.refresh()

    def _button(self, label: str, action: Any) -> None:
        self.panel.client.gui.add_button(label).on_click(lambda _: self.panel.act(action))

    def refresh(self) -> None:
        """Show the clusters and the selection of the edited scene."""
        sizes = self.session.cluster_sizes()
        options = tuple(f"{number} ({size} particles)" for number, size in enumerate(sizes)) or ("-",)
        if self.clusters.options != options:
            self.clusters.options = options
        count = int(self.session.selected.sum())
        text = f"**{count}** particles selected, {len(self.session.operations())} edits"
        self.status.content = text + ("  \nDrag a rectangle around what to select." if self._armed else "")
        self._place_gizmo()

    def _select(self, selector: Selector | None) -> None:
        self.panel.step.value = 0
        self.session.select(selector, self.how.value)
        self.refresh()
        self.panel.redraw()

    def _select_cluster(self) -> None:
        number = self.clusters.value.split()[0]
        self._select(Cluster(int(number)) if number.isdigit() else None)

    def _select_color(self) -> None:
        self._select(Color([channel / 255 for channel in self.color.value], self.tolerance.value))

    def _arm_rectangle(self) -> None:
        scene = self.panel.client.scene
        scene.remove_rect_select_callback()
        self._armed = bool(self.rectangle.value)
        if self._armed:

            @scene.on_rect_select()
            def _(event: Any) -> None:
                self.panel.act(lambda: self._select(self.rectangle_selector(event.screen_min, event.screen_max)))

        self.refresh()  # the hint reaches the browser after the callback: whoever sees it can drag

    def rectangle_selector(self, low: tuple[float, float], high: tuple[float, float]) -> Selector:
        """Return what the browser's camera sees in a rectangle of the screen (shares of its width and height)."""
        cameras = self.panel.viewpoint().cameras(1000)
        (left, top), (right, bottom) = (np.array(p) * (cameras.width, cameras.height) for p in (low, high))
        corners = [[left, top], [right, top], [right, bottom], [left, bottom]]
        return Lasso(
            cameras.intrinsics[0].double().tolist(),
            cameras.cam_to_world[0].double().tolist(),
            [[float(x), float(y)] for x, y in corners],
        )

    def _apply(self, operation: Any) -> None:
        self._edit(lambda: self.session.apply(operation))

    def _edit(self, action: Any) -> None:
        action()
        self.panel.edited()

    def _duplicate(self) -> None:
        width = self.panel.opened.workspace_max[0] - self.panel.opened.workspace_min[0]
        self._apply(Duplicate(self.session.need_selection(), (_BESIDE * width, 0.0, 0.0)))

    def _set_velocity(self) -> None:
        self._apply(SetVelocity(self.session.need_selection(), tuple(self.velocity.value)))

    def _keep(self) -> None:
        self.session.keep()
        self.panel.notify("Kept", "It stands beside; edit on, and simulate to compare.")
        self.panel.redraw()

    def _forget(self) -> None:
        self.session.kept = None
        self.panel.redraw()

    def _load(self) -> None:
        """Apply an uploaded edit; files beside it (inserted scenes) cannot come along and are refused by name."""
        import tempfile
        from pathlib import Path

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "edit.yaml"
            path.write_bytes(self.upload.value.content)
            operations = load_edit(path)
        for operation in operations:
            self.session.apply(operation)
        self.panel.edited()

    # The gizmo

    def _place_gizmo(self) -> None:
        for handle in (self._gizmo, self._preview):
            if handle is not None:
                handle.remove()
        self._gizmo = self._preview = None
        chosen = self.session.selected
        if not bool(chosen.any()):
            return
        points = self.session.now.states[0].positions[0][chosen].double().cpu().numpy()
        center = points.mean(axis=0)
        scene = self.panel.client.scene
        size = max(float(np.linalg.norm(np.ptp(points, axis=0))), 0.05)
        self._preview = scene.add_point_cloud(
            "/preview",
            (points - center).astype(np.float32),
            (255, 200, 80),
            point_size=self.panel.point_size.value / 100,
            precision="float32",
            position=center,
            visible=False,
        )
        self._gizmo = scene.add_transform_controls("/gizmo", scale=0.7 * size, depth_test=False, position=center)

        @self._gizmo.on_update
        def _(_: Any) -> None:
            if self._preview is not None and self._gizmo is not None:
                self._preview.visible = True
                self._preview.position, self._preview.wxyz = self._gizmo.position, self._gizmo.wxyz

    def show_gizmo(self, visible: bool) -> None:
        """Show the gizmo where there is one: an edit is of the last input frame, and not of what is predicted."""
        if self._gizmo is not None:
            self._gizmo.visible = visible

    def _move(self) -> None:
        selector = self.session.need_selection()
        if self._gizmo is None:
            return
        chosen = self.session.selected
        center = self.session.now.states[0].positions[0][chosen].double().mean(dim=0).cpu().numpy()
        shift = (np.asarray(self._gizmo.position) - center).tolist()
        self._apply(Move(selector, shift, tuple(float(value) for value in self._gizmo.wxyz), center.tolist()))
