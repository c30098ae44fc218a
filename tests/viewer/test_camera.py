"""A film is that of a recorded camera; who turns the camera leaves it, also where messages overtake each other."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("viser")

from tests.viewer.clients import camera_message, only_page
from tests.waiting import wait_until
from vpd_lightning.viewer.screen import FILM, PICTURE


def test_a_camera_that_was_turned_before_it_arrived_is_put_there_again(tmp_path: Path) -> None:
    with only_page(tmp_path) as (panel, connection):
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
