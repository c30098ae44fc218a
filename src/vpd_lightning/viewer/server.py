"""Start the viewer: one guarded server, one panel for each browser that comes."""

from pathlib import Path
from typing import Any

import viser

from vpd_lightning.viewer.exports import ExportFolder
from vpd_lightning.viewer.guard import HOST, cap_uploads, start_guarded_server
from vpd_lightning.viewer.opened_scene import OpenedScene
from vpd_lightning.viewer.panel import Panel


class Viewer:
    """A running viewer; ``url`` holds the token."""

    def __init__(self, opened: OpenedScene, folder: Path, port: int, token: str, num_steps: int):
        self.opened = opened
        self.panels: dict[int, Panel] = {}
        self.server: viser.ViserServer = start_guarded_server(port, token, "VPD")
        self.port = self.server.get_port()
        self.url = f"http://{HOST}:{self.port}/?token={token}"
        exports = ExportFolder(folder)
        _place_initial_camera(self.server, opened)

        @self.server.on_client_connect
        def _(client: Any) -> None:
            cap_uploads(client.gui)
            self.panels[client.client_id] = Panel(client, opened, exports, num_steps)

        @self.server.on_client_disconnect
        def _(client: Any) -> None:
            panel = self.panels.pop(client.client_id, None)
            if panel is not None:
                panel.close()

    def stop(self) -> None:
        """Close all connections and the port."""
        for panel in list(self.panels.values()):
            panel.close()
        self.server.stop()


def _place_initial_camera(server: viser.ViserServer, opened: OpenedScene) -> None:
    pose = opened.cameras.cam_to_world[opened.input_views[0]].double().numpy()
    server.initial_camera.position = pose[:3, 3]
    server.initial_camera.look_at = opened.target
    server.initial_camera.up = (0.0, 0.0, 1.0)
