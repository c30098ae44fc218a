"""A film is that of a recorded camera; who turns the camera leaves it, also where messages overtake each other."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("viser")

from tests.viewer.clients import camera_message, drain, settled_panel, socket_of
from tests.viewer.opened import open_tossed_box
from tests.waiting import wait_until
from vpd_lightning.viewer.screen import FILM, PICTURE
from vpd_lightning.viewer.server import Viewer

TOKEN = "a-token-for-tests"


def test_a_camera_that_was_turned_before_it_arrived_is_put_there_again(tmp_path: Path) -> None:
    viewer = Viewer(0, TOKEN)
    try:
        viewer.show(open_tossed_box(tmp_path), tmp_path / "view", 3)
        with socket_of(viewer, f"?token={TOKEN}") as connection:
            connection.send(camera_message())
            drain(connection)
            panel = settled_panel(viewer, set())
            told = panel.opened.cameras.cam_to_world[panel.screen.view][:3, 3].numpy()

            def is_put_back() -> bool:
                return np.allclose(panel.client.camera.position, told, atol=1e-6)

            wait_until(is_put_back)
            assert panel.screen.mode == FILM
            # It never said that it had arrived: the visitor was faster.
            connection.send(camera_message((1.0, 2.0, 3.0)))
            wait_until(lambda: tuple(panel._strayed) == (1.0, 2.0, 3.0))
            wait_until(is_put_back)
            assert panel.screen.mode == FILM

            connection.send(camera_message(tuple(map(float, told))))
            wait_until(lambda: panel._arrived)
            connection.send(camera_message((1.0, 2.0, 3.0)))
            wait_until(lambda: panel.screen.mode == PICTURE)
    finally:
        viewer.stop()
