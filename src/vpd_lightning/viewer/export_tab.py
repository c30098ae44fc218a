"""The tab that writes files, and hands them to the browser."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from vpd_lightning.errors import EditError
from vpd_lightning.media.video import enlarge
from vpd_lightning.types import Cameras
from vpd_lightning.viewer.exports import FILM_FORMATS, PARTICLE_FORMATS
from vpd_lightning.viewer.interpolation import between
from vpd_lightning.viewer.progressive_view import Request
from vpd_lightning.viewer.session import to_uint8
from vpd_lightning.viewer.tab_host import TabHost
from vpd_lightning.viewer.viewpoints import FreeViewpoint

_PATH_FPS = 10.0
_STEPS_BETWEEN = 20
_MAX_FILM_ROWS = 512


class ExportTab:
    """The film or the particles shown, a picture, a camera path, the edits: written, and downloaded."""

    def __init__(self, panel: TabHost):
        self.panel = panel
        self._places: list[FreeViewpoint] = []
        gui: Any = panel.client.gui
        self.format = gui.add_dropdown("film as", FILM_FORMATS, initial_value="webm")
        self._button("Save film", self._film)
        self.progress = gui.add_progress_bar(0.0, visible=False)
        self._button("Save picture (PNG)", self._picture)
        self.suffix = gui.add_dropdown("particles as", PARTICLE_FORMATS, initial_value="ply")
        self._button("Save particles", self._particles)
        self._button("Save edit (YAML)", lambda: self._hand_over(panel.folder.edit(panel.session.operations())))
        with gui.add_folder("camera path", expand_by_default=False):
            self.count = gui.add_markdown("0 places")
            self._button("Add this view", self._add_place)
            self._button("Save camera path", self._save_path)
        gui.add_markdown(f"Files are downloaded, and stay in `{panel.folder.folder}`.")

    def _button(self, label: str, action: Any) -> None:
        self.panel.client.gui.add_button(label).on_click(lambda _: self.panel.act(action))

    def _hand_over(self, path: Path) -> None:
        self.panel.client.send_file_download(path.name, path.read_bytes(), save_immediately=True)
        self.panel.notify("Saved", str(path))

    def _particles(self) -> None:
        state, colors = self.panel.session.shown(int(self.panel.step.value))
        self._hand_over(self.panel.folder.particles(state, colors, self.suffix.value))

    def _picture(self) -> None:
        shown = self.panel.screen.last_shown
        if shown is None:
            raise EditError("There is no picture.\nShow the film or the free camera first.")
        self._hand_over(self.panel.folder.picture(shown))

    def _film(self) -> None:
        """Film what is shown: frames that were drawn already are taken as they are."""
        session, screen = self.panel.session, self.panel.screen
        last = max(rollout.num_steps for rollout in screen.rollouts())
        if last == 0:
            raise EditError("There is no rollout to film.\nWait until it is simulated.")
        frames: list[Any] = []
        self.progress.visible = True
        try:
            for step in range(last + 1):
                if self.panel.is_left:
                    return
                request = self.panel.request(step)
                frames.append(self._drawn(request) if request is not None else self._from_here(session, step))
                self.progress.value = 100.0 * (step + 1) / (last + 1)
        finally:
            self.progress.visible = False
        size = frames[0].shape[1::-1]
        even = [frame if frame.shape[1::-1] == size else cv2.resize(frame, size) for frame in frames]
        self._hand_over(self.panel.folder.film(np.stack(even), float(self.panel.view_tab.fps.value), self.format.value))

    def _drawn(self, request: Request) -> Any:
        picture = self.panel.screen.composed(request, self.panel.view.draw(request))
        return enlarge(picture) if len(picture) < _MAX_FILM_ROWS else picture

    def _from_here(self, session: Any, step: int) -> Any:
        view = self.panel.screen.free_viewpoint().cameras(min(self.panel.screen.rows, _MAX_FILM_ROWS))
        return enlarge(to_uint8(self.panel.opened.simulator.render([session.shown_state(step)], view)[0, 0]))

    def _add_place(self) -> None:
        self._places.append(self.panel.screen.free_viewpoint())
        self.count.content = f"{len(self._places)} places"

    def _save_path(self) -> None:
        """Save a camera that goes smoothly from place to place."""
        if not self._places:
            raise EditError("The camera path has no places.\nAdd the view of the browser first.")
        aspect, rows = self._places[0].aspect, self.panel.screen.rows
        cameras = [
            FreeViewpoint(pose, fov, aspect).cameras(rows)
            for pose, fov in between([(p.cam_to_world, p.fov) for p in self._places], _STEPS_BETWEEN)
        ]
        path = Cameras(
            torch.cat([camera.intrinsics for camera in cameras]),
            torch.cat([camera.cam_to_world for camera in cameras]),
            cameras[0].height,
            cameras[0].width,
        )
        self._hand_over(self.panel.folder.camera_path(path, _PATH_FPS))
