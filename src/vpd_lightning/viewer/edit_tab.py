"""The tab that selects and edits."""

from typing import Any

import numpy as np

from vpd_lightning.editing.edit_files import load_edit
from vpd_lightning.editing.operations import Delete, Duplicate, Move, Scale, SetVelocity
from vpd_lightning.editing.selectors import Cluster, Color, Everything, Lasso, Selector
from vpd_lightning.viewer.body_handles import BodyHandles
from vpd_lightning.viewer.screen import PICTURE
from vpd_lightning.viewer.session import COMBINATIONS
from vpd_lightning.viewer.tab_host import TabHost

_NOTHING = "nothing"


class EditTab:
    """Selection by click, list, rectangle and colour; edits of what is selected; comparison; edits from a file."""

    def __init__(self, panel: TabHost):
        self.panel, self.session = panel, panel.session
        gui: Any = panel.client.gui
        self.status = gui.add_markdown("")
        self.clusters = gui.add_dropdown("body", (_NOTHING,), initial_value=_NOTHING)
        self._button("Delete", self.delete)
        self._button("Duplicate", self._duplicate)
        self._button("Move by hand", self._move)
        with gui.add_folder("velocity and size", expand_by_default=False):
            self.velocity = gui.add_vector3("velocity (m a step)", (0.0, 0.0, 0.0), step=0.01)
            self._button("Set velocity", self._set_velocity)
            self.factor = gui.add_number("scale", 1.5, min=0.05, max=20.0, step=0.05)
            self._button("Scale", self._scale)
        with gui.add_folder("more ways to select", expand_by_default=False):
            self.how = gui.add_dropdown("a new selection will", COMBINATIONS, initial_value="replace")
            self.rectangle = gui.add_checkbox("drag rectangles", False, hint="while on, dragging selects")
            self.color = gui.add_rgb("colour", (200, 60, 60))
            self.tolerance = gui.add_slider("tolerance", 0.02, 0.6, 0.02, 0.2)
            self._button("Select colour", self._select_color)
            self._button("Select all", lambda: self._select(Everything()))
            self._button("Select none", lambda: self._select(None))
        with gui.add_folder("compare with", expand_by_default=False):
            self._button("This scene from now on", self._keep)
            self._button("Swap the two", lambda: panel.edit(self.session.swap))
            self._button("The recording again", self._forget)
        self.upload = gui.add_upload_button("Load edit (YAML)", mime_type=".yaml")
        self.upload.on_upload(lambda _: panel.act(self._load))
        self.clusters.on_update(lambda event: panel.act(lambda: self._chosen(event)))
        self.rectangle.on_update(lambda _: panel.act(self._arm_rectangle))
        self.handles = BodyHandles(panel, self.select_cluster, self.move)
        self._armed = False

    def _button(self, label: str, action: Any) -> None:
        self.panel.client.gui.add_button(label).on_click(lambda _: self.panel.act(action))

    def refresh(self) -> None:
        """Show the bodies and the selection of the edited scene."""
        names = self.session.body_names()
        sizes = self.session.cluster_sizes()
        options = (_NOTHING, *(f"{name} ({size} particles)" for name, size in zip(names, sizes, strict=True)))
        if self.clusters.options != options:
            self.clusters.options = options
        self._show_selection()
        self.handles.renew()

    def _show_selection(self) -> None:
        body, count = self.session.selected_body, int(self.session.selected.sum())
        self.clusters.value = self.clusters.options[0 if body is None else body + 1]
        what = f"**{self.name}** is selected: {count} particles" if count else "Click a body to select it."
        self.status.content = what + ("  \nDrag a rectangle around what to select." if self._armed else "")
        self.handles.show_selected()

    @property
    def name(self) -> str:
        """Return what is selected, in words."""
        body = self.session.selected_body
        return "the selection" if body is None else f"the {self.session.body_names()[body]}"

    def _select(self, selector: Selector | None) -> None:
        self.session.select(selector, self.how.value)
        self._show_selection()
        self.panel.redraw()

    def select_cluster(self, number: int | None) -> None:
        """Select a body, or nothing."""
        self._select(None if number is None else Cluster(number))

    def _chosen(self, event: Any) -> None:
        if event.client is not None and self.clusters.value in self.clusters.options:
            number = self.clusters.options.index(self.clusters.value) - 1
            self.select_cluster(number if number >= 0 else None)

    def _select_color(self) -> None:
        self._select(Color([channel / 255 for channel in self.color.value], self.tolerance.value))

    def _arm_rectangle(self) -> None:
        scene = self.panel.client.scene
        scene.remove_rect_select_callback()
        self._armed = bool(self.rectangle.value)
        if self._armed:
            self.panel.set_mode(PICTURE)

            @scene.on_rect_select()
            def _(event: Any) -> None:
                self.panel.act(lambda: self._select(self.rectangle_selector(event.screen_min, event.screen_max)))

        self._show_selection()  # the hint reaches the browser after the callback: whoever sees it can drag

    def rectangle_selector(self, low: tuple[float, float], high: tuple[float, float]) -> Selector:
        """Return what the browser's camera sees in a rectangle of the screen (shares of its width and height).

        Where there are bodies in it, those parts of them, and not the floor behind.
        """
        cameras = self.panel.screen.free_viewpoint().cameras(1000)
        (left, top), (right, bottom) = (np.array(p) * (cameras.width, cameras.height) for p in (low, high))
        corners = [[left, top], [right, top], [right, bottom], [left, bottom]]
        lasso = Lasso(
            cameras.intrinsics[0].double().tolist(),
            cameras.cam_to_world[0].double().tolist(),
            [[float(x), float(y)] for x, y in corners],
        )
        bodies = self.session.bodies()
        in_front = lasso if bodies is None else lasso & bodies
        return in_front if bool(self.session.now.editor.select(in_front).any()) else lasso

    # Edits

    def delete(self) -> None:
        """Take away what is selected."""
        self._apply(Delete(self.session.need_selection()), f"without {self.name}")

    def _apply(self, operation: Any, label: str) -> None:
        self.panel.edit(lambda: self.session.apply(operation, label))

    def _duplicate(self) -> None:
        """Put a copy where the camera sees it: beside the original, across the line of sight, and not over it."""
        selector, name = self.session.need_selection(), self.name
        points = self.session.now.states[0].positions[0][self.session.selected].double().cpu().numpy()
        right = self.panel.screen.viewpoint().cameras(100).cam_to_world[0, :3, 0].double().numpy()
        right[2] = 0.0
        right /= max(float(np.linalg.norm(right)), 1e-9)
        width = float(np.ptp(points @ right))
        low, high = np.array(self.panel.opened.workspace_min), np.array(self.panel.opened.workspace_max)
        center, room = points.mean(axis=0), 0.5 * width
        shifts = [sign * 1.3 * width * right for sign in (1.0, -1.0)]
        fits = [shift for shift in shifts if ((center + shift > low + room) & (center + shift < high - room))[:2].all()]
        self._apply(
            Duplicate(selector, tuple((fits or shifts)[0].tolist())), f"with a second {name.removeprefix('the ')}"
        )

    def _set_velocity(self) -> None:
        name = self.name
        self._apply(SetVelocity(self.session.need_selection(), tuple(self.velocity.value)), f"{name} thrown otherwise")

    def _scale(self) -> None:
        name, factor = self.name, self.factor.value
        self._apply(Scale(self.session.need_selection(), factor), f"{name} scaled by {factor:g}")

    def move(self, shift: list[float], wxyz: tuple[float, ...], center: list[float]) -> None:
        """Turn what is selected about ``center``, then shift it (metres)."""
        turn = (wxyz[0], wxyz[1], wxyz[2], wxyz[3])
        self._apply(Move(self.session.need_selection(), shift, turn, center), f"{self.name} moved")

    def _move(self) -> None:
        """Show the scene from the browser's camera at its first step, where what is selected can be dragged."""
        self.session.need_selection()
        self.panel.set_playing(False)
        self.panel.screen.compares = self.panel.view_tab.compares.value = False
        self.panel.set_mode(PICTURE)
        self.panel.go_to(0)

    def _keep(self) -> None:
        self.session.keep()
        self.panel.notify("Kept", "What is edited from now on is compared with this scene.")
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
        self.panel.edit(lambda: self.session.apply_all(operations))

    def show_handles(self, visible: bool) -> None:
        """Let bodies be dragged: an edit is of the last input frame, and not of what is predicted."""
        self.handles.show(visible)
