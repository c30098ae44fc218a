"""One client's panel: what its buttons do to its session, and what its browser shows."""

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from vpd_lightning.errors import VPDError
from vpd_lightning.viewer.act_tab import ActTab
from vpd_lightning.viewer.captions import figures, sentence
from vpd_lightning.viewer.edit_tab import EditTab
from vpd_lightning.viewer.export_tab import ExportTab
from vpd_lightning.viewer.exports import ExportFolder
from vpd_lightning.viewer.opened_scene import OpenedScene
from vpd_lightning.viewer.preset_buttons import PresetButtons
from vpd_lightning.viewer.progressive_view import Pictures, ProgressiveView, Request
from vpd_lightning.viewer.scene_drawing import SceneDrawing
from vpd_lightning.viewer.screen import FILM, PARTICLES, PICTURE, Screen
from vpd_lightning.viewer.session import Session
from vpd_lightning.viewer.tab_host import TabHost
from vpd_lightning.viewer.view_tab import ViewTab

_MOVED = 0.001
"""A camera that moved by this share of its distance to what it looks at was moved by hand."""

_FIRST_SECONDS = 5.0
_POLL_SECONDS = 0.02


class Panel(TabHost):
    """Connects a browser with a session; every client has its own, so that nothing is shared but the model.

    A ``session`` of a page that was left may be given, with the ``mode`` (see ``Screen``) that it was in.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        opened: OpenedScene,
        folder: ExportFolder,
        num_steps: int,
        session: Session | None = None,
        mode: str = FILM,
    ):
        self.client, self.opened, self.folder = client, opened, folder
        self.session = Session(opened) if session is None else session
        self.screen = Screen(client, self.session)
        self.screen.mode = mode
        self.drawing = SceneDrawing(client, self.session)
        self.view = ProgressiveView(opened.simulator.renderer, self._show_picture, opened.frames)
        self.touched_at = time.monotonic()
        self._playing, self._closed = threading.Event(), threading.Event()
        self._busy, self._truth_busy, self._stepping = threading.Lock(), threading.Lock(), threading.RLock()
        self._first_shown = threading.Event()
        self._told, self._arrived = np.zeros(3), False  # where the browser's camera was put, and whether it went there
        self._strayed = np.zeros(3)  # where it was instead when it was put there again
        gui: Any = client.gui
        self.look_through(self.screen.view)
        gui.add_markdown(f"### {opened.title}")
        self.said = gui.add_markdown("")
        self.play = gui.add_button("Pause", icon="player-pause")
        self.step = gui.add_slider("step", 0, 1, 1, 0, disabled=True)
        self.figures = gui.add_markdown("")
        self.presets = PresetButtons(self)
        self.history = gui.add_button_group("history", ("Undo", "Redo", "Start over"))
        tabs = gui.add_tab_group()
        with tabs.add_tab("View"):
            self.view_tab = ViewTab(self, num_steps)
        with tabs.add_tab("Edit"):
            self.edit_tab = EditTab(self)
        self.act_tab = None
        if self.session.tool is not None:
            with tabs.add_tab("Act"):
                self.act_tab = ActTab(self)
        with tabs.add_tab("Save"):
            self.export_tab = ExportTab(self)
        self.play.on_click(lambda _: self.act(self.toggle_play))
        self.step.on_update(lambda event: self.act(lambda: self._step_chosen(event)))
        self.history.on_click(lambda _: self.act(self._history))
        client.scene.on_click()(lambda event: self.act(lambda: self._clicked(event)))
        client.camera.on_update(lambda _: self.act(self._camera_moved))
        self._add_keys()
        self.set_playing(True)
        self.redraw()
        for work in (self._play, self._begin):
            threading.Thread(target=work, daemon=True, name="vpd-view film").start()

    def _begin(self) -> None:
        """Do all that can wait for the first picture."""
        if self.screen.mode != PARTICLES:
            self._first_shown.wait(_FIRST_SECONDS)
        self._attempt(self.edit_tab.refresh)
        self._attempt(self.presets.refresh)
        self.run_simulation()

    def _add_keys(self) -> None:
        def step(by: int) -> None:
            self.set_playing(False)
            self.go_to(min(max(int(self.step.value) + by, 0), self._last_step()))

        keys: tuple[tuple[str, str, str | None, Callable[[], Any]], ...] = (
            ("Play or pause", "space", None, self.toggle_play),
            ("Next step", "arrowright", None, lambda: step(1)),
            ("Step back", "arrowleft", None, lambda: step(-1)),
            ("Delete what is selected", "delete", None, self.edit_tab.delete),
            ("Undo", "Z", "cmd/ctrl", lambda: self.edit(self.session.undo)),
            ("Redo", "Y", "cmd/ctrl", lambda: self.edit(self.session.redo)),
            ("Select nothing", "escape", None, lambda: self.select_body(None)),
        )
        for label, hotkey, modifier, action in keys:
            command = self.client.gui.add_command(label, hotkey=hotkey, modifier=modifier)  # type: ignore[arg-type]
            command.on_trigger(self._acting(action))

    def _acting(self, action: Callable[[], Any]) -> Callable[[Any], None]:
        return lambda _: self.act(action)

    # What happens

    def act(self, action: Callable[[], Any]) -> None:
        """Do what a button asks for; what cannot be done is said in the browser, and nothing else happens."""
        if self.is_left:
            return
        self.touched_at = time.monotonic()
        self._attempt(action)
        self.touched_at = time.monotonic()  # what took long has only just been done

    def _attempt(self, action: Callable[[], Any]) -> None:
        try:
            action()
        except VPDError as error:
            self.notify("That cannot be done", str(error), "red")
        except Exception as error:  # whatever happens, the other clients and this one go on
            self.notify("That went wrong", f"{type(error).__name__}: {error}", "red")

    def notify(self, title: str, text: str, color: Any = "green") -> None:
        """Say something in the browser."""
        if not self._closed.is_set():
            self.client.add_notification(title, text, auto_close_seconds=8, color=color)

    def run_simulation(self) -> None:
        """Simulate the scene shown, and what it is compared with, as far as asked for; the film grows meanwhile."""
        with self._busy:
            for _ in iter(self._simulate_once, True):
                pass

    def _simulate_once(self) -> bool:
        """Simulate; False where an edit came in between, and there is another scene to simulate."""
        wanted, done = int(self.view_tab.length.value), [True]

        def shown(_: int) -> None:
            self._allow_steps()
            self.view.film_grew()

        def simulate() -> None:
            done[0] = self.session.simulate(wanted, shown, self._closed.is_set)

        self._attempt(simulate)
        return done[0] or self._closed.is_set()

    def simulate_again(self) -> None:
        """Simulate in the background, unless that goes on already."""
        if not self._busy.locked():
            threading.Thread(target=self.run_simulation, daemon=True, name="vpd-view simulation").start()

    def edit(self, action: Callable[[], Any]) -> None:
        """Edit the scene, and show what becomes of it."""
        action()
        self.edited()

    def edited(self) -> None:
        """Show a scene that was just edited: from its beginning, playing."""
        self._allow_steps()
        self.edit_tab.refresh()
        if self.act_tab is not None:
            self.act_tab.refresh()
        self.presets.refresh()
        self.go_to(0)
        self.simulate_again()
        self.simulate_truth_again()
        self.set_playing(True)

    def simulate_truth_again(self) -> None:
        """Have the generator's own simulation make the same edits, in the background, where it can."""
        if self.screen.shows_true and self.view_tab.can_simulate and self.session.now.is_edited:
            threading.Thread(target=self._simulate_truth, daemon=True, name="vpd-view MuJoCo").start()

    def _simulate_truth(self) -> None:
        from vpd_lightning.viewer.counterfactual import counterfactual

        with self._truth_busy:
            rollout = self.session.now
            if rollout.true_pictures is not None or not rollout.is_edited or self._closed.is_set():
                return
            operations, wanted = rollout.editor.operations, int(self.view_tab.length.value)

            def simulate() -> None:
                rollout.true_pictures = counterfactual(self.opened, operations, wanted)

            self._attempt(simulate)
        if rollout is self.session.now and rollout.true_pictures is not None:
            self.redraw()

    def select_body(self, cluster: int | None) -> None:
        """Select a body, or nothing."""
        self.edit_tab.select_cluster(cluster)

    def start_over(self) -> None:
        """Begin again as on the first visit."""
        self.session.start_over()
        self.screen.compares = self.view_tab.compares.value = True
        self.view_tab.mode.value = self.screen.mode = FILM
        self.look_through(self.screen.view)
        self.edited()

    def start_over_if_left(self, seconds: float) -> None:
        """Begin again where nobody has touched the page for so long."""
        if time.monotonic() - self.touched_at > seconds and not self.is_untouched:
            self._attempt(self.start_over)

    @property
    def is_untouched(self) -> bool:
        """Whether the page shows what the first visit shows."""
        session = self.session
        nothing_done = session.now is self.opened.rollout and session.kept is None and session.selector is None
        return nothing_done and self.screen.mode == FILM and self._playing.is_set()

    def _history(self) -> None:
        word = self.history.value
        if word == "Start over":
            self.start_over()
        else:
            self.edit(self.session.undo if word == "Undo" else self.session.redo)

    def _clicked(self, event: Any) -> None:
        x, y = event.screen_pos
        body = self.screen.pick(float(x), float(y), int(self.step.value))
        if body is not None or bool(self.session.selected.any()):
            self.select_body(body)

    def _step_chosen(self, event: Any) -> None:
        if event.client is not None:  # a person, not ``go_to``
            self.set_playing(False)
            self.redraw()

    # Playing

    def toggle_play(self) -> None:
        """Play, or pause."""
        self.set_playing(not self._playing.is_set())

    def set_playing(self, plays: bool) -> None:
        """Let the film run, or stop it where it is."""
        with self._stepping:  # not while the film goes on to its next step
            if plays:
                self._playing.set()
            else:
                self._playing.clear()
        self.play.label = "Pause" if plays else "Play"
        self.play.icon = "player-pause" if plays else "player-play"
        if not plays:
            self.redraw()

    def go_to(self, step: int) -> None:
        """Show a step."""
        self.step.value = step
        self.redraw()

    def _last_step(self) -> int:
        rollouts = self.screen.rollouts()
        return min(int(self.view_tab.length.value), max(rollout.num_steps for rollout in rollouts))

    def _allow_steps(self) -> None:
        last = self._last_step()
        self.step.disabled = last == 0
        self.step.max = max(last, 1)

    def _play(self) -> None:
        while not self._closed.is_set():
            if not self._playing.wait(timeout=0.5) or self._closed.is_set():
                continue
            self._attempt(self._advance)

    def _advance(self) -> None:
        """Show the next step as soon as its picture is there."""
        last = self._last_step()
        following = int(self.step.value) + 1
        if following > last:
            following = 0 if last > 0 and not self._busy.locked() else last
        request = self.request(following)
        if following == int(self.step.value) or (request is not None and not self.view.is_ready(request)):
            self._closed.wait(_POLL_SECONDS)
            return
        with self._stepping:
            if self._playing.is_set():
                self.go_to(following)
        self._closed.wait(1.0 / self.view_tab.fps.value)

    # What is shown

    def redraw(self) -> None:
        """Draw the current step."""
        self._attempt(self._redraw)

    def _redraw(self) -> None:
        step, mode = int(self.step.value), self.screen.mode
        size = self.view_tab.point_size.value / 100
        alone = len(self.screen.rollouts()) == 1
        in_space = mode == PARTICLES or (mode == PICTURE and alone)
        self.drawing.particles(step, mode == PARTICLES, size, self.screen.compares)
        self.drawing.paths(step if in_space and self.view_tab.paths_shown.value else None)
        self.drawing.velocities(step if in_space and self.view_tab.arrows_shown.value else None, size)
        self.drawing.cameras(in_space and self.view_tab.cameras_shown.value, self.screen.view)
        self.drawing.measured(step if in_space and self.view_tab.truth_shown.value else None, size)
        self.edit_tab.show_handles(in_space and step == 0)
        if self.act_tab is not None:
            self.act_tab.show_handles(in_space and step == 0, step if in_space else None)
        self.said.content = sentence(self.screen)
        self.ask_picture()
        self._show_figures(step)

    def _show_figures(self, step: int) -> None:
        may_render = self.screen.mode != FILM and not self._playing.is_set()
        self.figures.content = figures(self.screen, step, may_render)

    def request(self, step: int) -> Request | None:
        """Return what to draw of a step; None where no picture is shown."""
        return self.screen.request(step, int(self.view_tab.length.value), self.view.is_ready)

    def ask_picture(self) -> None:
        """Have the step shown rendered, where a picture is shown."""
        request = self.request(int(self.step.value))
        if request is None:
            self.screen.clear()
        self.view.ask(request)

    def _show_picture(self, request: Request, pictures: Pictures, is_full: bool) -> None:
        if self._closed.is_set():
            return
        self.screen.show(request, pictures, is_full)
        self._first_shown.set()
        if is_full and self.screen.mode == FILM and not self.session.now.is_edited:
            self._attempt(lambda: self._show_figures(int(self.step.value)))

    def look_through(self, view: int) -> None:
        """Put the browser's camera where a recorded one is, and show its film."""
        self.screen.view = view
        self._put_camera(view)

    def _put_camera(self, view: int) -> None:
        cameras, camera = self.opened.cameras, self.client.camera
        pose = cameras.cam_to_world[view].double().numpy()
        self._told, self._arrived = pose[:3, 3], False
        with self.client.atomic():
            camera.position = pose[:3, 3]
            camera.look_at = pose[:3, 3] + pose[:3, 2] * np.linalg.norm(self.opened.target - pose[:3, 3])
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.fov = float(2 * np.arctan(0.5 * cameras.height / cameras.intrinsics[view, 1, 1]))

    def _camera_moved(self) -> None:
        position = np.asarray(self.client.camera.position)
        is_there = np.linalg.norm(position - self._told) < _MOVED * np.linalg.norm(self.opened.target - self._told)
        self._arrived |= bool(is_there)
        if self.screen.mode == FILM and self._arrived and not is_there:
            self.set_mode(PICTURE)  # a film is that of a recorded camera
            return
        # A visitor who turns the camera before it is known to have arrived would never leave the film, however often:
        # what is reported is where it is by now. Once for each place, should a browser keep it elsewhere.
        if self.screen.mode == FILM and not is_there and not np.array_equal(position, self._strayed):
            self._strayed = position
            self._put_camera(self.screen.view)
        if self.screen.mode != PARTICLES:
            self.ask_picture()  # also where the canvas has another size

    def set_mode(self, mode: str) -> None:
        """Show the film, the picture of the browser's camera, or particles."""
        self.screen.mode = mode
        self.view_tab.mode.value = mode
        self.redraw()

    @property
    def is_left(self) -> bool:
        """Whether the browser is gone: what takes long ends then."""
        return self._closed.is_set()

    def close(self) -> None:
        """End what runs for this client."""
        self._closed.set()
        self._playing.set()
        self.view.stop()
