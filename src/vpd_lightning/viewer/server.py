"""Start the viewer: one guarded server, one panel for each browser that comes.

The server starts before PyTorch is imported and the model is read, so that the browser can load the page meanwhile.
"""

import threading
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import viser

from vpd_lightning.viewer.guard import HOST, limit_messages, start_guarded_server

if TYPE_CHECKING:
    from vpd_lightning.viewer.opened_scene import OpenedScene
    from vpd_lightning.viewer.panel import Panel
    from vpd_lightning.viewer.session import Session

_KEPT_SECONDS = 60.0
"""So long a page that was left is kept for the next one: a reload takes a few seconds."""

_KEPT_PAGES = 4


@dataclass(frozen=True)
class _LeftPage:
    session: "Session"
    mode: str
    left_at: float


class Viewer:
    """A running viewer; ``url`` holds the token. It shows what is being loaded until ``show`` gives it a scene.

    A page that is reloaded finds its edits again. With ``kiosk`` seconds, a page that nobody touched for so long begins
    again as on the first visit.
    """

    def __init__(self, port: int, token: str, kiosk: float | None = None):
        self.panels: dict[int, Panel] = {}
        self._left: list[_LeftPage] = []
        self._kiosk, self._stopped = kiosk, threading.Event()
        self._loading = "Loading the model ..."
        self._waiting: dict[int, tuple[Any, Any]] = {}
        self._make_panel: Any = None
        self._lock = threading.Lock()
        self.server: viser.ViserServer = start_guarded_server(port, token, "VPD")
        self.port = self.server.get_port()
        self.url = f"http://{HOST}:{self.port}/?token={token}"
        # A page may be left at any time; messages sent to it afterwards are lost, as they should be.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
        self.server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(self._part)

    def show(self, opened: "OpenedScene", folder: Path, num_steps: int) -> None:
        """Give every browser, those that wait and those to come, a panel of its own; files go to ``folder``."""
        from vpd_lightning.viewer.exports import ExportFolder
        from vpd_lightning.viewer.panel import Panel

        pose = opened.cameras.cam_to_world[opened.input_views[0]].double().numpy()
        self.server.initial_camera.position = pose[:3, 3]
        self.server.initial_camera.look_at = opened.target
        self.server.initial_camera.up = (0.0, 0.0, 1.0)
        exports = ExportFolder(folder)
        self.opened = opened
        with self._lock:
            self._make_panel = lambda client, *left: Panel(client, opened, exports, num_steps, *left)
            waiting, self._waiting = self._waiting, {}
        for client, note in waiting.values():
            note.remove()
            self._add_panel(client)
        if self._kiosk is not None:
            threading.Thread(target=self._reset_idle, daemon=True, name="vpd-view kiosk").start()

    def say(self, text: str) -> None:
        """Tell the browsers that wait what is being loaded."""
        with self._lock:
            self._loading = text
            for _, note in self._waiting.values():
                note.content = text

    def stop(self) -> None:
        """Close all connections and the port."""
        self._stopped.set()
        for panel in list(self.panels.values()):
            panel.close()
        self.server.stop()

    def _welcome(self, client: Any) -> None:
        limit_messages(client.gui)
        with self._lock:
            if self._make_panel is None:
                self._waiting[client.client_id] = client, client.gui.add_markdown(self._loading)
                return
        self._add_panel(client)

    def _add_panel(self, client: Any) -> None:
        with self._lock:
            now = time.monotonic()
            self._left = [page for page in self._left if now - page.left_at < _KEPT_SECONDS]
            page = self._left.pop() if self._left else None
        panel = self._make_panel(client) if page is None else self._make_panel(client, page.session, page.mode)
        with self._lock:
            self.panels[client.client_id] = panel
        if client.client_id not in self.server.get_clients():  # it left meanwhile
            self._part(client)

    def _part(self, client: Any) -> None:
        with self._lock:
            self._waiting.pop(client.client_id, None)
            panel = self.panels.pop(client.client_id, None)
            if panel is not None:
                page = _LeftPage(panel.session, panel.screen.mode, time.monotonic())
                self._left = [*self._left, page][-_KEPT_PAGES:]
        if panel is not None:
            panel.close()

    def _reset_idle(self) -> None:
        assert self._kiosk is not None
        while not self._stopped.wait(min(self._kiosk / 4, 5.0)):
            for panel in list(self.panels.values()):
                panel.start_over_if_left(self._kiosk)
