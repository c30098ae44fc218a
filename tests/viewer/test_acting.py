"""Moving the tool in the viewer: by hand, and as planned. Metres."""

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

from tests.evaluation.pushed_box import BELOW, STEP, write_pushed_boxes
from tests.evaluation.untrained_model import write_untrained
from tests.viewer.clients import camera_message, drain, settled_panel, socket_of
from tests.waiting import wait_until
from vpd_lightning.editing.operations import Move
from vpd_lightning.editing.selectors import Everything
from vpd_lightning.errors import ActionError, EditError
from vpd_lightning.loading import load_model
from vpd_lightning.viewer.opened_scene import OpenedScene, open_scene
from vpd_lightning.viewer.panel import Panel
from vpd_lightning.viewer.server import Viewer
from vpd_lightning.viewer.session import Session


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> OpenedScene:
    folder = tmp_path_factory.mktemp("acting")
    data = write_pushed_boxes(folder / "data")
    model = load_model(write_untrained(folder / "run", data, "actions=true"))
    return open_scene(model.simulator, data / "test" / "000000.h5", 0, model.input_views, "pushed box", "pushing")


@pytest.fixture(scope="module")
def panel(opened: OpenedScene, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Panel]:
    viewer = Viewer(0, "a-token-for-tests")
    try:
        viewer.show(opened, tmp_path_factory.mktemp("view"), 3)
        with socket_of(viewer, "?token=a-token-for-tests") as connection:
            connection.send(camera_message())
            drain(connection)
            yield settled_panel(viewer, set())
    finally:
        viewer.stop()


def tool_at(session: Session, step: int) -> Any:
    driven = session.now.states[step].driven
    assert driven is not None
    return driven.positions[0].mean(dim=0)


def test_the_tool_moves_as_recorded_until_it_is_told_otherwise(opened: OpenedScene) -> None:
    session = Session(opened)
    session.simulate(2)
    start = tool_at(session, 0)
    assert tool_at(session, 2) - start == pytest.approx([2 * STEP, 0, 0], abs=1e-6) and session.has_truth(2)
    assert session.tool is not None
    session.drive(session.tool[:1], "stays")
    assert session.label(session.now) == "stays" and not session.has_truth(1)
    session.simulate(2)
    assert tool_at(session, 2) == pytest.approx(start, abs=1e-6)
    assert session.other is opened.rollout, "compared with what was recorded"


def test_an_edit_keeps_what_the_tool_does(opened: OpenedScene) -> None:
    session = Session(opened)
    assert session.tool is not None
    session.drive(session.tool[:1], "stays")
    session.apply(Move(Everything(), (0.0, 0.0, 0.1)), "all moved")
    assert session.label(session.now) == "all moved, stays"
    session.undo()
    assert session.label(session.now) == "stays" and session.now.is_edited
    session.drive(None, "")
    assert session.now is opened.rollout and session.label(session.now) == "as recorded"


def test_stops_are_a_path_of_the_tool(panel: Panel) -> None:
    tab, session = panel.act_tab, panel.session
    assert tab is not None and "moves as recorded" in tab.status.content
    tab.speed.value = 5.0
    start = tool_at(session, 0)[:2].double().numpy()
    tab.add_stop(start + [0.0, 0.1])
    tab.add_stop(start + [0.07, 0.1])
    motion = session.now.motion
    assert motion is not None and "goes to 2 stops" in tab.status.content
    middle = motion.positions.double().mean(dim=1).numpy()
    assert len(middle) == 4 and middle[1, :2] == pytest.approx(start + [0.0, 0.1], abs=1e-6)
    assert middle[-1, :2] == pytest.approx(start + [0.07, 0.1], abs=1e-6)
    wait_until(lambda: session.now.num_steps >= 3)
    tab._back()
    assert "goes to 1 stop" in tab.status.content and len(tab.stops) == 1
    panel.start_over()
    assert not tab.stops and "moves as recorded" in tab.status.content
    with pytest.raises(ActionError, match="no stop"):
        tab._back()


def test_handles_stand_where_the_tool_will_be(panel: Panel) -> None:
    tab, session = panel.act_tab, panel.session
    assert tab is not None
    panel.start_over()
    tab._show_in_space()
    wait_until(lambda: "tool" in tab.handles._handles)
    recorded = session.now.motion
    assert recorded is not None
    last = recorded.positions[-1].double().mean(dim=0).numpy()
    assert tab.handles._handles["tool"].position == pytest.approx(last, abs=1e-6)
    place = tool_at(session, 0)[:2].double().numpy() + [0.0, 0.05]
    tab.add_stop(place)
    panel.set_playing(False)
    panel.go_to(0)
    assert tab.handles._handles["tool"].position[:2] == pytest.approx(place, abs=1e-6)


def test_what_is_dragged_is_a_stop_where_it_is_let_go(panel: Panel) -> None:
    import asyncio

    tab = panel.act_tab
    assert tab is not None
    panel.start_over()
    tab._show_in_space()
    gizmo = tab.handles._handles["tool"]
    place = np.array([0.1, 0.2, BELOW])
    drag = gizmo._impl_aux.update_cb[-1]
    for phase in ("start", "update", "end"):
        asyncio.run(drag(SimpleNamespace(target=SimpleNamespace(position=place), phase=phase)))
    wait_until(lambda: "Drag on for the next stop" in tab.status.content)
    assert len(tab.stops) == 1 and tab.stops[0] == pytest.approx(place[:2])


def test_a_plan_is_played_and_says_what_is_expected(panel: Panel) -> None:
    tab, session = panel.act_tab, panel.session
    assert tab is not None
    panel.start_over()
    with pytest.raises(EditError, match="Nothing is selected"):
        tab._show_goal()
    session.select(Everything())
    with pytest.raises(ActionError, match="no goal"):
        tab.start_planning()
    tab._show_goal()
    assert tab.handles.goal is not None and not session.selected.any(), "its arrows are not under those of the body"
    session.apply(Move(Everything(), (0.0, 0.0, 0.1)))
    with pytest.raises(ActionError, match="no goal in this scene"):
        tab.start_planning()
    session.undo()
    tab.candidates.value, tab.knots.value = 8, 2
    tab.start_planning()
    wait_until(lambda: session.now.acts == "does what was planned")
    wait_until(lambda: "from the goal, after 16 futures tried" in tab.status.content)
    assert session.now.motion is not None and len(session.now.motion.positions) == 8


def test_a_scene_without_a_recorded_motion_has_no_tool(opened: OpenedScene) -> None:
    bare = replace(opened, rollout=type(opened.rollout)(opened.simulator, opened.rollout.editor, None))
    assert Session(bare).tool is None and Session(opened).tool is not None
