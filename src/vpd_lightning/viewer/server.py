"""Start the viewer: one guarded server, one panel for each browser that comes.

The server starts before PyTorch is imported and the model is read, so that the browser can load the page meanwhile.
"""

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import viser

from vpd_lightning.viewer.guard import HOST, cap_uploads, start_guarded_server

if TYPE_CHECKING:
    from vpd_lightning.viewer.opened_scene import OpenedScene
    from vpd_lightning.viewer.panel import Panel


class Viewer:
    """A running viewer; ``url`` holds the token. It says that it is loading until ``show`` gives it a scene."""

    def __init__(self, port: int, token: str):
        self.panels: dict[int, Panel] = {}
        self._waiting: dict[int, tuple[Any, Any]] = {}
        self._make_panel: Any = None
        self._lock = threading.Lock()
        self.server: viser.ViserServer = start_guarded_server(port, token, "VPD")
        self.port = self.server.get_port()
        self.url = f"http://{HOST}:{self.port}/?token={token}"
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
            self._make_panel = lambda client: Panel(client, opened, exports, num_steps)
            waiting, self._waiting = self._waiting, {}
        for client, note in waiting.values():
            note.remove()
            self._add_panel(client)

    def stop(self) -> None:
        """Close all connections and the port."""
        for panel in list(self.panels.values()):
            panel.close()
        self.server.stop()

    def _welcome(self, client: Any) -> None:
        cap_uploads(client.gui)
        with self._lock:
            if self._make_panel is None:
                self._waiting[client.client_id] = client, client.gui.add_markdown("Loading the model ...")
                return
        self._add_panel(client)

    def _add_panel(self, client: Any) -> None:
        panel = self._make_panel(client)
        with self._lock:
            self.panels[client.client_id] = panel
        if client.client_id not in self.server.get_clients():  # it left meanwhile
            self._part(client)

    def _part(self, client: Any) -> None:
        with self._lock:
            self._waiting.pop(client.client_id, None)
            panel = self.panels.pop(client.client_id, None)
        if panel is not None:
            panel.close()
