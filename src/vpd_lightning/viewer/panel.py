"""One client's panel: what its buttons do to its session, and what its browser shows."""

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from vpd_lightning.errors import VPDError
from vpd_lightning.metrics.registry import CHAMFER, PSNR, metric
from vpd_lightning.viewer.edit_tab import EditTab
from vpd_lightning.viewer.export_tab import ExportTab
from vpd_lightning.viewer.exports import ExportFolder, as_pose
from vpd_lightning.viewer.opened_scene import OpenedScene
from vpd_lightning.viewer.progressive_view import ProgressiveView, Request, Viewpoint
from vpd_lightning.viewer.scene_drawing import SceneDrawing
from vpd_lightning.viewer.session import Session
from vpd_lightning.viewer.tab_host import TabHost

MODES = ("particles", "rendered", "both")
_POINT_SIZE = 1.5  # centimetres


class Panel(TabHost):
    """Connects a browser with a session; every client has its own, so that nothing is shared but the model."""

    def __init__(self, client: viser.ClientHandle, opened: OpenedScene, folder: ExportFolder, num_steps: int):
        self.client, self.opened, self.folder = client, opened, folder
        self.session = Session(opened)
        self.drawing = SceneDrawing(client, self.session)
        self.view = ProgressiveView(opened.simulator.renderer, self._show_picture)
        self._playing, self._closed = threading.Event(), threading.Event()
        self._busy = threading.Lock()
        self._looks_through: int | None = None
        gui: Any = client.gui
        gui.configure_theme(show_share_button=False, control_width="medium")
        self.look_through(opened.input_views[0])
        self.drawing.first_particles(_POINT_SIZE / 100)  # the buttons and the renderer's colours take a second more
        gui.add_markdown(f"**{opened.title}**")
        with gui.add_folder("Rollout"):
            self.step = gui.add_slider("step", 0, 1, 1, 0, disabled=True)
            self.transport = gui.add_button_group("time", ("start", "back", "step", "play"))
            self.fps = gui.add_slider("steps per second", 1, 30, 1, 10)
            self.length = gui.add_number("steps to simulate", num_steps, min=1, max=1000, step=1)
            self.simulate = gui.add_button("Simulate")
            self.figures = gui.add_markdown("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Edit"):
            self.edit_tab = EditTab(self)
        with tabs.add_tab("View"):
            self._add_view_tab()
        with tabs.add_tab("Truth"):
            self._add_truth_tab()
        with tabs.add_tab("Export"):
            self.export_tab = ExportTab(self)
        self.step.on_update(lambda _: self.redraw())
        self.transport.on_click(lambda _: self.act(self._transport))
        self.simulate.on_click(lambda _: self.act(self.run_simulation))
        client.camera.on_update(lambda _: self.ask_picture())
        threading.Thread(target=self._play, daemon=True, name="vpd-view playing").start()
        self.redraw()

    def _add_view_tab(self) -> None:
        gui: Any = self.client.gui
        self.mode = gui.add_dropdown("show", MODES, initial_value="particles")
        self.rows = gui.add_slider("rows of the picture", 32, 768, 16, 256)
        self.point_size = gui.add_slider("point size (cm)", 0.2, 10.0, 0.1, _POINT_SIZE)
        self.cameras_shown = gui.add_checkbox("cameras", True)
        self.truth_shown = gui.add_checkbox("measured points", False)
        look = gui.add_dropdown(
            "look through camera",
            tuple(str(view) for view in range(len(self.opened.cameras.intrinsics))),
            initial_value="0",
        )
        for handle in (self.mode, self.rows, self.point_size, self.cameras_shown, self.truth_shown):
            handle.on_update(lambda _: self.redraw())

        @look.on_update
        def _(_: Any) -> None:
            self.look_through(int(look.value))
            self.redraw()

    def _add_truth_tab(self) -> None:
        gui: Any = self.client.gui
        views = tuple(str(view) for view in range(len(self.opened.cameras.intrinsics)))
        self.truth_view = gui.add_dropdown("camera", views, initial_value=str(self.opened.input_views[0]))
        blank = np.zeros((self.opened.cameras.height, self.opened.cameras.width, 3), np.uint8)
        self.true_image = gui.add_image(blank, label="recorded")
        self.predicted_image = gui.add_image(blank, label="predicted")
        self.truth_view.on_update(lambda _: self.redraw())

    # What happens

    def act(self, action: Callable[[], Any]) -> None:
        """Do what a button asks for; what cannot be done is said in the browser, and nothing else happens."""
        try:
            action()
        except VPDError as error:
            self.notify("That cannot be done", str(error), "red")
        except Exception as error:  # whatever happens, the other clients and this one go on
            self.notify("That went wrong", f"{type(error).__name__}: {error}", "red")

    def notify(self, title: str, text: str, color: Any = "green") -> None:
        """Say something in the browser."""
        self.client.add_notification(title, text, auto_close_seconds=8, color=color)

    def run_simulation(self) -> None:
        """Simulate the edited scene, showing each step as it comes."""
        if not self._busy.acquire(blocking=False):
            return
        try:
            start = time.perf_counter()
            wanted = int(self.length.value)

            def show(step: int) -> None:
                self._allow_steps()
                self.step.value = step

            if self.session.simulate(wanted, show):
                each = (time.perf_counter() - start) / wanted
                self.notify("Simulated", f"{wanted} steps, {1000 * each:.0f} ms each")
        finally:
            self._busy.release()
        self.redraw()

    def edited(self) -> None:
        """Show a scene that was just edited."""
        self._playing.clear()
        self._allow_steps()
        self.step.value = 0
        self.edit_tab.refresh()
        self.redraw()

    def _allow_steps(self) -> None:
        last = self.session.now.num_steps
        if self.session.kept is not None:
            last = max(last, self.session.kept.num_steps)
        self.step.disabled = last == 0
        self.step.max = max(last, 1)

    def _transport(self) -> None:
        word = self.transport.value
        last = max(self.session.now.num_steps, self.session.kept.num_steps if self.session.kept else 0)
        if last == 0:
            self.run_simulation()
            return
        if word == "play":
            if self._playing.is_set():
                self._playing.clear()
            else:
                self._playing.set()
            return
        self._playing.clear()
        now = int(self.step.value)
        self.step.value = 0 if word == "start" else min(max(now + (1 if word == "step" else -1), 0), last)

    def _play(self) -> None:
        while not self._closed.is_set():
            if not self._playing.wait(timeout=0.5) or self._closed.is_set():
                continue
            last = int(self.step.max)
            self.step.value = 0 if int(self.step.value) >= last else int(self.step.value) + 1
            self._closed.wait(1.0 / self.fps.value)

    # What is shown

    def redraw(self) -> None:
        """Draw the current step."""
        self.act(self._redraw)

    def _redraw(self) -> None:
        step = int(self.step.value)
        with_points = self.mode.value != "rendered"
        self.drawing.particles(step, with_points, self.point_size.value / 100)
        self.drawing.cameras(self.cameras_shown.value, self._looks_through)
        self.drawing.measured(step if self.truth_shown.value else None, self.point_size.value / 100)
        self.edit_tab.show_gizmo(step == 0)
        self.ask_picture()
        if not self._playing.is_set() and not self._busy.locked():
            self._show_truth(step)

    def _show_truth(self, step: int) -> None:
        view = int(self.truth_view.value)
        image = self.session.render(step, self.opened.cameras[view : view + 1])[0]
        self.predicted_image.image = image
        known = step <= self.opened.num_true_steps
        self.true_image.image = self.opened.truth[step, view] if known else np.zeros_like(image)
        figures = self.session.measure(step, view, image)
        lines = [f"step **{step}** of {self.session.now.num_steps}, {int(figures['particles'])} particles"]
        if known:
            seen, near = metric(PSNR), metric(CHAMFER)
            lines.append(f"camera {view}: {seen.title} **{seen.shown(figures[PSNR])} {seen.printed_unit}**")
            lines.append(f"to measured points: **{near.shown(figures[CHAMFER])} {near.printed_unit}** ({near.title})")
        else:
            lines.append("behind the end of the recording")
        self.figures.content = "  \n".join(lines)

    def viewpoint(self) -> Viewpoint:
        """Return the browser's camera."""
        camera = self.client.camera
        return Viewpoint(as_pose(camera.wxyz, camera.position), float(camera.fov), float(camera.aspect))

    def ask_picture(self) -> None:
        """Have the browser's view rendered, where that is shown."""
        if self.mode.value == "particles":
            self.view.ask(None)
            self.client.scene.set_background_image(None)
            return
        step = int(self.step.value)
        states = [self.session.shown_state(step)]
        if self.session.kept is not None:
            states.append(self.session.shown_state(step, of_kept=True))
        self.view.ask(Request(states, self.viewpoint(), int(self.rows.value)))

    def _show_picture(self, image: np.ndarray, is_full: bool) -> None:
        if self.mode.value != "particles":
            self.client.scene.set_background_image(image, format="jpeg", jpeg_quality=90 if is_full else 75)

    def look_through(self, view: int) -> None:
        """Put the browser's camera where a recorded one is."""
        cameras, camera = self.opened.cameras, self.client.camera
        self._looks_through = view
        pose = cameras.cam_to_world[view].double().numpy()
        camera.position = pose[:3, 3]
        camera.look_at = pose[:3, 3] + pose[:3, 2] * np.linalg.norm(self.opened.target - pose[:3, 3])
        camera.up_direction = (0.0, 0.0, 1.0)
        camera.fov = float(2 * np.arctan(0.5 * cameras.height / cameras.intrinsics[view, 1, 1]))

    def close(self) -> None:
        """End what runs for this client."""
        self._closed.set()
        self._playing.set()
        self.view.stop()
