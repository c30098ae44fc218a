"""A page that nobody touches begins again."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("viser")

from tests.viewer.clients import camera_message, drain, settled_panel, socket_of
from tests.viewer.opened import open_tossed_box
from tests.waiting import wait_until
from vpd_lightning.editing.operations import Delete
from vpd_lightning.editing.selectors import Box
from vpd_lightning.viewer.panel import Panel
from vpd_lightning.viewer.screen import FILM, PARTICLES
from vpd_lightning.viewer.server import Viewer

TOKEN = "a-token-for-tests"


@contextmanager
def exhibition(folder: Path) -> Iterator[tuple[Viewer, Panel]]:
    """A viewer that begins again soon, and its panel, which one page shows."""
    viewer = Viewer(0, TOKEN, kiosk=0.2)
    try:
        viewer.show(open_tossed_box(folder), folder / "view", 3)
        with socket_of(viewer, f"?token={TOKEN}") as connection:
            connection.send(camera_message())
            drain(connection)
            yield viewer, settled_panel(viewer, set())
    finally:
        viewer.stop()


def test_an_exhibition_begins_again_where_nobody_touches_it(tmp_path: Path) -> None:
    with exhibition(tmp_path) as (viewer, panel):
        counts = []

        def edit() -> None:
            panel.session.apply(Delete(Box([-9, -9, -9], [0, 9, 9])))
            counts.append(len(panel.session.operations()))
            panel.set_mode(PARTICLES)
            panel.set_playing(False)

        panel.act(lambda: panel.edit(edit))
        wait_until(lambda: panel.is_untouched)
        assert counts == [1] and panel.session.operations() == []
        assert panel.screen.mode == FILM and panel.session.now is viewer.opened.rollout


def test_what_goes_wrong_once_does_not_end_the_exhibition(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with exhibition(tmp_path) as (_, panel):
        start_over, failed = panel.start_over, []

        def fail_once() -> None:
            if not failed:
                failed.append(True)
                raise RuntimeError("the page was redrawn meanwhile")
            start_over()

        monkeypatch.setattr(panel, "start_over", fail_once)
        panel.act(lambda: panel.set_mode(PARTICLES))
        wait_until(lambda: failed and panel.is_untouched)
