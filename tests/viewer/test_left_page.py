"""A browser that is closed leaves no work behind: its film is not drawn on, and buttons still waiting do nothing."""

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("viser")

from tests.viewer.clients import only_page
from tests.waiting import wait_until


def test_a_film_of_a_page_that_is_closed_ends_and_is_not_saved(tmp_path: Path) -> None:
    with only_page(tmp_path) as (panel, connection):
        wait_until(lambda: panel.session.now.num_steps == 3)
        tab, drawn = panel.export_tab, []
        frame = tab._drawn

        def draw_and_leave(request: Any) -> Any:
            drawn.append(request)
            picture = frame(request)
            connection.close()
            wait_until(lambda: panel.is_left)
            return picture

        tab._drawn = draw_and_leave
        tab._film()
        assert len(drawn) == 1 and not list((tmp_path / "view").rglob("*.*"))

        done: list[int] = []
        panel.act(lambda: done.append(1))
        assert done == []
