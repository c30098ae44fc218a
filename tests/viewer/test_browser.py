"""The viewer in a real browser: what a visitor sees, clicks, drags, compares, saves and finds again."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("viser")
pytest.importorskip("playwright")

from playwright.sync_api import Page, sync_playwright

import vpd_lightning as vpd
from tests.editing.scenes import same
from tests.released_demo import demo_model, make_demo_data
from tests.viewer.browsing import (
    STEPS,
    TIMEOUT,
    block_by_camera,
    block_on_screen,
    blue,
    canvas,
    choose,
    click_block,
    drag,
    is_drawn,
    pane,
    press,
    repeat_until,
    tab,
    wait_until,
)
from vpd_lightning.editing.edit_files import load_edit, replay
from vpd_lightning.editing.operations import Move
from vpd_lightning.editing.selectors import Cluster
from vpd_lightning.geometry.cameras import project
from vpd_lightning.metrics.registry import PSNR, metric
from vpd_lightning.viewer.guard import new_token
from vpd_lightning.viewer.opened_scene import open_scene
from vpd_lightning.viewer.panel import Panel
from vpd_lightning.viewer.server import Viewer

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
RECORDED, PREDICTED, ERROR = range(3)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium (apt-get install chromium)"),
]


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    folder = tmp_path_factory.mktemp("browser")
    model = demo_model()
    path = make_demo_data(folder / "data") / "test" / "000000.h5"
    viewer = Viewer(0, new_token())
    opened = open_scene(model.simulator, path, 4, model.input_views, "Mujoco block, test recording 0", "mujoco_block")
    viewer.show(opened, folder / "view", STEPS)
    yield viewer
    viewer.stop()


@pytest.fixture(scope="module")
def page(viewer: Viewer) -> Iterator[Page]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=GL)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(TIMEOUT)
        requested: list[str] = []
        page.on("request", lambda request: requested.append(request.url))
        page.goto(viewer.url)
        page.get_by_text("Mujoco block, test recording 0").wait_for()
        yield page
        ours = (f"http://127.0.0.1:{viewer.port}/", f"ws://127.0.0.1:{viewer.port}/", "data:", "blob:")
        assert requested and all(url.startswith(ours) for url in requested)  # nothing leaves this machine
        browser.close()


def panel_of(viewer: Viewer, page: Page) -> Panel:
    """The panel of the only page."""
    wait_until(page, lambda: len(viewer.panels) == 1)
    return next(iter(viewer.panels.values()))


@pytest.fixture
def panel(viewer: Viewer, page: Page) -> Panel:
    """The panel, as on the first visit but paused at its first step, with its film drawn."""
    panel = panel_of(viewer, page)
    panel.start_over()
    wait_until(page, lambda: panel.session.now.num_steps == STEPS and not panel._busy.locked())
    wait_until(page, lambda: is_drawn(panel))
    panel.set_playing(False)
    panel.go_to(0)
    return panel


# What a visitor does


def test_it_opens_on_a_film_in_which_the_block_moves_as_predicted(page: Page, viewer: Viewer) -> None:
    panel = panel_of(viewer, page)
    wait_until(page, lambda: blue(pane(page, panel, PREDICTED, 3)).sum() > 50)
    places: list[np.ndarray] = []

    def look() -> bool:
        image = pane(page, panel, PREDICTED, 3)
        if blue(image).sum() > 50:
            places.append(block_on_screen(image))
        return len(places) > 1 and np.ptp(np.stack(places), axis=0).max() > 0.05

    wait_until(page, look)  # nobody clicked anything: it plays by itself, round and round
    page.get_by_text("The model saw two frames").wait_for()


def test_every_step_has_its_picture_and_its_figures(page: Page, panel: Panel) -> None:
    for step in (1, 2, 3):
        repeat_until(page, lambda: page.keyboard.press("ArrowRight"), lambda step=step: int(panel.step.value) >= step)
        assert int(panel.step.value) == step
        page.get_by_text(f"step {step} of {STEPS}").wait_for()
        picture = panel.screen.film_picture(step)
        shown = metric(PSNR).shown(panel.session.measure(step, panel.screen.view, picture)[PSNR])
        page.get_by_text(f"{metric(PSNR).title} {shown} {metric(PSNR).printed_unit}").wait_for()
        wait_until(page, lambda step=step: distance(page, panel, PREDICTED, 3, panel.session.now, step) < 0.08)
    place = np.array(panel.client.camera.position)

    def hold_left() -> None:  # by which viser would turn the camera
        page.keyboard.down("ArrowLeft")
        page.wait_for_timeout(300)
        page.keyboard.up("ArrowLeft")

    repeat_until(page, hold_left, lambda: int(panel.step.value) < 3)
    assert int(panel.step.value) == 2
    assert np.allclose(panel.client.camera.position, place)
    repeat_until(page, lambda: page.keyboard.press(" "), lambda: panel._playing.is_set())
    press(page, "Pause")
    wait_until(page, lambda: not panel._playing.is_set())
    now = int(panel.step.value)
    page.get_by_text(f"step {now} of {STEPS}").wait_for()


def distance(page: Page, panel: Panel, number: int, count: int, rollout: Any, step: int) -> float:
    """Between the block in a pane and the block's particles, as a share of the pane."""
    image = pane(page, panel, number, count)
    if not blue(image).any():
        return 1.0
    return float(np.abs(block_on_screen(image) - block_by_camera(panel, rollout, step)).max())


def test_a_click_and_delete_take_the_block_and_its_shadow_away(page: Page, panel: Panel) -> None:
    recorded, without, count = 0, 1, 2
    click_block(page, panel, PREDICTED, 3)
    assert panel.session.selector == Cluster(0)
    repeat_until(page, lambda: page.keyboard.press("Delete"), lambda: len(panel.session.operations()) == 1)
    page.get_by_text("edited: no truth to compare with").wait_for()
    page.get_by_text("as recorded").first.wait_for()
    wait_until(page, lambda: is_drawn(panel))
    press(page, "Pause")
    panel.go_to(2)
    wait_until(page, lambda: blue(pane(page, panel, recorded, count)).mean() > 0.002)
    wait_until(page, lambda: blue(pane(page, panel, without, count)).mean() < 0.0001)
    before, after = (pane(page, panel, number, count).mean(axis=-1) for number in (recorded, without))
    floor = np.median(after)
    shadow = before < 0.75 * floor  # block and shadow are the only dark things on the pale floor
    assert shadow.sum() > 100 and np.median(after[shadow]) > 0.9 * floor

    repeat_until(page, lambda: page.keyboard.press("Control+z"), lambda: panel.session.operations() == [])
    wait_until(page, lambda: blue(pane(page, panel, PREDICTED, 3)).mean() > 0.002)
    repeat_until(page, lambda: page.keyboard.press("Control+y"), lambda: len(panel.session.operations()) == 1)
    edited = panel.session.now.editor.scene
    assert same(vpd.SceneEditor(panel.opened.scene).delete(Cluster(0)).scene, edited)


def test_the_block_is_dragged_and_both_panes_show_it_where_it_is(page: Page, panel: Panel) -> None:
    click_block(page, panel, PREDICTED, 3)
    tab(page, "Edit")
    press(page, "Move by hand")
    wait_until(page, lambda: panel.edit_tab.handles._hulls and panel.edit_tab.handles._hulls[0].visible)
    page.wait_for_timeout(1000)  # the browser draws the hull, which nothing reports
    camera = panel.screen.free_viewpoint().cameras(int(panel.client.camera.image_height))
    state, chosen = panel.session.now.states[0], panel.session.selected
    points = state.positions[0][chosen].double()
    pixels, _ = project(points, camera[0].to(torch.float64))
    x, y = pixels.mean(dim=0).tolist()
    # Beside the middle, where the gizmo's arrows are not.
    offset = 0.25 * float(pixels[:, 0].max() - pixels[:, 0].min())

    def drag_block() -> None:
        page.mouse.move(x - offset, y + offset)
        page.mouse.down()
        for moved in range(1, 11):
            page.mouse.move(x - offset + 6 * moved, y + offset - 3 * moved)
        assert panel.session.operations() == []  # not before it is let go
        page.mouse.up()

    repeat_until(page, drag_block, lambda: len(panel.session.operations()) == 1)
    assert isinstance(panel.session.operations()[0], Move)
    shift = panel.session.now.states[0].positions[0][panel.session.now.editor.select(Cluster(0))].mean(dim=0)
    assert float((shift - points.mean(dim=0)).norm()) > 0.01

    tab(page, "View")
    choose(page, "show", "film")
    page.get_by_label("compare edits").click()
    wait_until(page, lambda: len(panel.screen.rollouts()) == 2 and is_drawn(panel))
    panel.set_playing(False)
    for step in (0, 2):
        panel.go_to(step)
        for number, rollout in enumerate(panel.screen.rollouts()):
            wait_until(page, lambda n=number, r=rollout, s=step: distance(page, panel, n, 2, r, s) < 0.08)


def test_particles_and_a_free_camera_are_a_click_away(page: Page, panel: Panel) -> None:
    tab(page, "View")
    choose(page, "show", "particles")
    page.get_by_text("The particles that the model moves").wait_for()
    wait_until(page, lambda: blue(canvas(page, panel)).sum() > 100)
    choose(page, "show", "film")
    wait_until(page, lambda: blue(pane(page, panel, PREDICTED, 3)).sum() > 50)
    turned = page.get_by_text("from any side")  # turning the camera leaves the film
    repeat_until(page, lambda: drag(page, (300, 650), (380, 620)), turned.is_visible)
    wait_until(page, lambda: blue(canvas(page, panel)).sum() > 100)


def test_a_button_takes_the_block_away_and_films_come_down(page: Page, panel: Panel, tmp_path: Path) -> None:
    press(page, "Take the block away")
    wait_until(page, lambda: len(panel.session.operations()) == 1 and is_drawn(panel))
    tab(page, "Save")
    film = download(page, "Save film", tmp_path)
    reader, frames = cv2.VideoCapture(str(film)), []
    while (found := reader.read())[0]:
        frames.append(found[1])
    assert film.suffix == ".webm" and len(frames) == STEPS + 1
    first = np.ascontiguousarray(frames[0][..., ::-1])
    half = first.shape[1] // 2
    assert blue(first[:, :half]).mean() > 0.001 > 50 * blue(first[:, half:]).mean()  # as recorded, and without
    it_plays(page, film)
    picture = cv2.imread(str(download(page, "Save picture (PNG)", tmp_path)))
    assert picture.shape == panel.screen.last_shown.shape
    edit = download(page, "Save edit (YAML)", tmp_path)
    assert same(replay(panel.opened.scene, load_edit(edit)).scene, panel.session.now.editor.scene)
    assert download(page, "Save particles", tmp_path).suffix == ".ply"


def download(page: Page, button: str, folder: Path) -> Path:
    with page.expect_download() as coming:
        press(page, button)
    path = folder / coming.value.suggested_filename
    coming.value.save_as(path)
    return path


def it_plays(page: Page, film: Path) -> None:
    (film.parent / "play.html").write_text(f'<video id="film" src="{film.name}" muted></video>')
    other = page.context.browser.new_page()
    other.goto((film.parent / "play.html").as_uri())
    other.evaluate("document.getElementById('film').play()")
    other.wait_for_function("document.getElementById('film').ended", timeout=TIMEOUT)
    size = other.evaluate(
        "(() => { const f = document.getElementById('film'); return [f.videoWidth, f.videoHeight]; })()"
    )
    assert min(size) >= 256 and other.evaluate("document.getElementById('film').error") is None
    other.close()


def test_a_reload_finds_the_edit_again(page: Page, panel: Panel, viewer: Viewer) -> None:
    press(page, "Take the block away")
    wait_until(page, lambda: len(panel.session.operations()) == 1)
    page.reload()
    page.get_by_text("Mujoco block, test recording 0").wait_for()
    wait_until(page, lambda: len(viewer.panels) == 1 and panel_of(viewer, page) is not panel)
    again = panel_of(viewer, page)
    assert again.session is panel.session and len(again.session.operations()) == 1
    wait_until(page, lambda: blue(pane(page, again, 0, 2)).mean() > 0.002)
    wait_until(page, lambda: blue(pane(page, again, 1, 2)).mean() < 0.0001)


def test_a_rectangle_selects_what_the_camera_sees_in_it(page: Page, panel: Panel) -> None:
    tab(page, "Edit")
    page.get_by_text("more ways to select").click()
    page.get_by_label("drag rectangles").click()
    page.get_by_text("Drag a rectangle").wait_for()  # before it is there, dragging moves the camera
    rectangle = (60, 200), (400, 300), (800, 700)  # below the browser's notice
    repeat_until(page, lambda: drag(page, *rectangle), lambda: int(panel.session.selected.sum()) > 0)
    chosen = panel.session.selected
    lasso = panel.session.need_selection()
    assert torch.equal(panel.session.now.editor.select(lasso), chosen)
    assert 0 < int(chosen.sum()) < len(chosen)
    page.get_by_label("drag rectangles").click()
    page.get_by_text("Drag a rectangle").wait_for(state="hidden")


def test_a_second_browser_edits_a_scene_of_its_own(page: Page, panel: Panel, viewer: Viewer) -> None:
    other = page.context.browser.new_page(viewport={"width": 1000, "height": 700})
    other.set_default_timeout(TIMEOUT)
    other.goto(viewer.url)
    other.get_by_text("Mujoco block, test recording 0").wait_for()
    wait_until(other, lambda: len(viewer.panels) == 2)
    second = next(p for p in viewer.panels.values() if p is not panel)
    before = panel.session.now.editor.scene
    press(other, "Take the block away")
    wait_until(other, lambda: len(second.session.operations()) == 1)
    assert panel.session.now.editor.scene is before
    tab(other, "Edit")
    press(other, "Delete")  # nothing is selected: said in the browser, and nothing happens
    other.get_by_text("Nothing is selected").first.wait_for()
    other.close()
    wait_until(page, lambda: len(viewer.panels) == 1)


def test_without_the_token_the_browser_gets_no_page(page: Page, viewer: Viewer) -> None:
    context = page.context.browser.new_context()
    stranger = context.new_page()
    answer = stranger.goto(f"http://127.0.0.1:{viewer.port}/")
    assert answer is not None and answer.status == 403
    context.close()
