"""A browser that is closed leaves no work behind: its film is not drawn on, and buttons still waiting do nothing."""

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("viser")

from tests.viewer.clients import camera_message, drain, settled_panel, socket_of
from tests.viewer.opened import open_tossed_box
from tests.waiting import wait_until
from vpd_lightning.viewer.server import Viewer

TOKEN = "a-token-for-tests"


def test_a_film_of_a_page_that_is_closed_ends_and_is_not_saved(tmp_path: Path) -> None:
    viewer = Viewer(0, TOKEN)
    try:
        viewer.show(open_tossed_box(tmp_path), tmp_path / "view", 3)
        with socket_of(viewer, f"?token={TOKEN}") as connection:
            connection.send(camera_message())
            drain(connection)
            panel = settled_panel(viewer, set())
            wait_until(lambda: panel.session.now.num_steps == 3)
        wait_until(lambda: panel.is_left)

        panel._closed.clear()  # as if it were left after the first frame
        tab, drawn = panel.export_tab, []
        frame = tab._drawn

        def draw_and_leave(request: Any) -> Any:
            drawn.append(request)
            picture = frame(request)
            panel.close()
            return picture

        tab._drawn = draw_and_leave
        tab._film()
        assert len(drawn) == 1 and not list((tmp_path / "view").rglob("*.*"))

        done: list[int] = []
        panel.act(lambda: done.append(1))
        assert done == []
    finally:
        viewer.stop()
