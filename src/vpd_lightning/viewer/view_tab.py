"""The tab with what is shown, and how."""

from typing import Any

from vpd_lightning.viewer.opened_scene import OpenedScene
from vpd_lightning.viewer.picking import spacing
from vpd_lightning.viewer.screen import FILM, MODES
from vpd_lightning.viewer.tab_host import TabHost


class ViewTab:
    """Film, free camera or particles; speed and length of the film; points, cameras and measured points."""

    def __init__(self, panel: TabHost, num_steps: int):
        self.panel = panel
        gui: Any = panel.client.gui
        opened, screen = panel.opened, panel.screen
        views = tuple(str(view) for view in range(len(opened.cameras.intrinsics)))
        self.mode = gui.add_dropdown("show", MODES, initial_value=screen.mode)
        self.camera = gui.add_dropdown("camera", views, initial_value=str(screen.view))
        self.compares = gui.add_checkbox("compare edits", screen.compares)
        self.can_simulate = _can_simulate(opened)
        self.true_shown = gui.add_checkbox("beside MuJoCo's own", self.can_simulate, visible=self.can_simulate)
        self.fps = gui.add_slider("steps per second", 1, 30, 1, 5)
        self.length = gui.add_number("steps to simulate", num_steps, min=1, max=1000, step=1)
        self.rows = gui.add_slider("rows of a free picture", 32, 768, 16, screen.rows)
        size = round(100 * min(max(1.2 * spacing(opened.scene.current), 0.002), 0.1), 1)
        self.point_size = gui.add_slider("point size (cm)", 0.2, 10.0, 0.1, size)
        self.paths_shown = gui.add_checkbox("paths of particles", False)
        self.arrows_shown = gui.add_checkbox("velocity arrows", False)
        self.cameras_shown = gui.add_checkbox("cameras", False)
        self.truth_shown = gui.add_checkbox("measured points", False)
        self.mode.on_update(lambda event: panel.act(lambda: self._mode(event)))
        self.camera.on_update(lambda _: panel.act(self._camera))
        self.length.on_update(lambda _: panel.act(self._length))
        self.rows.on_update(lambda _: panel.act(self._rows))
        self.compares.on_update(lambda _: panel.act(self._compare))
        self.true_shown.on_update(lambda _: panel.act(self._show_true))
        shown = (self.paths_shown, self.arrows_shown, self.cameras_shown, self.truth_shown)
        for handle in (self.point_size, *shown):
            handle.on_update(lambda _: panel.act(panel.redraw))

    def _mode(self, event: Any) -> None:
        if event.client is not None and self.mode.value in MODES:
            self.panel.set_mode(self.mode.value)
            if self.mode.value == FILM:
                self.panel.look_through(self.panel.screen.view)

    def _camera(self) -> None:
        self.panel.look_through(int(self.camera.value))
        self.panel.redraw()

    def _rows(self) -> None:
        self.panel.screen.rows = int(self.rows.value)
        self.panel.redraw()

    def _compare(self) -> None:
        self.panel.screen.compares = bool(self.compares.value)
        self.panel.redraw()

    def _show_true(self) -> None:
        self.panel.screen.shows_true = bool(self.true_shown.value)
        self.panel.simulate_truth_again()
        self.panel.redraw()

    def _length(self) -> None:
        self.panel.simulate_again()
        self.panel.redraw()


def _can_simulate(opened: OpenedScene) -> bool:
    if opened.manifest is None:
        return False
    from vpd_lightning.viewer.counterfactual import can_simulate

    return can_simulate(opened)
