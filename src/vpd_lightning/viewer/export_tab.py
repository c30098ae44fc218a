"""The tab that writes files."""

from typing import Any

import numpy as np
import torch

from vpd_lightning.errors import EditError
from vpd_lightning.media.video import enlarge
from vpd_lightning.types import Cameras
from vpd_lightning.viewer.exports import PARTICLE_FORMATS
from vpd_lightning.viewer.progressive_view import Viewpoint
from vpd_lightning.viewer.session import to_uint8
from vpd_lightning.viewer.tab_host import TabHost

_PATH_FPS = 10.0


class ExportTab:
    """Particles of the step shown, a film of the rollout from the browser's camera, a camera path, the edits."""

    def __init__(self, panel: TabHost):
        self.panel = panel
        self._places: list[Viewpoint] = []
        gui: Any = panel.client.gui
        gui.add_markdown(f"Files go to `{panel.folder.folder}`")
        self.suffix = gui.add_dropdown("particles as", PARTICLE_FORMATS, initial_value="ply")
        self._button("Export particles", self._particles)
        self._button("Export film (WebM)", self._film)
        self._button("Export edit (YAML)", lambda: self._say(panel.folder.edit(panel.session.operations())))
        with gui.add_folder("camera path", expand_by_default=False):
            self.count = gui.add_markdown("0 places")
            self._button("Add this view", self._add_place)
            self._button("Save camera path", self._save_path)

    def _button(self, label: str, action: Any) -> None:
        self.panel.client.gui.add_button(label).on_click(lambda _: self.panel.act(action))

    def _say(self, path: Any) -> None:
        self.panel.notify("Written", str(path))

    def _particles(self) -> None:
        state, colors = self.panel.session.shown(int(self.panel.step.value))
        self._say(self.panel.folder.particles(state, colors, self.suffix.value))

    def _film(self) -> None:
        session, view = self.panel.session, self.panel.viewpoint()
        if session.now.num_steps == 0:
            raise EditError("There is no rollout to film.\nSimulate first.")
        cameras = view.cameras(min(int(self.panel.rows.value), 512))
        frames = [
            enlarge(to_uint8(self.panel.opened.simulator.render([state], cameras)[0, 0]))
            for state in list(session.now.states)
        ]
        self._say(self.panel.folder.film(np.stack(frames), float(self.panel.fps.value)))

    def _add_place(self) -> None:
        self._places.append(self.panel.viewpoint())
        self.count.content = f"{len(self._places)} places"

    def _save_path(self) -> None:
        rows = int(self.panel.rows.value)
        square = [
            Viewpoint(place.cam_to_world, place.fov, self._places[0].aspect).cameras(rows) for place in self._places
        ]
        if not square:
            raise EditError("The camera path has no places.\nAdd the view of the browser first.")
        cameras = Cameras(
            torch.cat([camera.intrinsics for camera in square]),
            torch.cat([camera.cam_to_world for camera in square]),
            square[0].height,
            square[0].width,
        )
        self._say(self.panel.folder.camera_path(cameras, _PATH_FPS))
