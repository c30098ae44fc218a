"""The viewer in a real browser: play, select, delete, simulate, export, and look whether the block is gone."""

import shutil
import time
from collections.abc import Callable, Iterator
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
from tests.waiting import HANG
from vpd_lightning.editing.edit_files import load_edit, replay
from vpd_lightning.editing.selectors import Cluster
from vpd_lightning.viewer.guard import new_token
from vpd_lightning.viewer.opened_scene import open_scene
from vpd_lightning.viewer.panel import Panel
from vpd_lightning.viewer.progressive_view import Request
from vpd_lightning.viewer.server import Viewer

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
TIMEOUT = 1000 * HANG  # milliseconds

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
    viewer.show(open_scene(model.simulator, path, 4, model.input_views, "demo"), folder / "view", 8)
    yield viewer
    viewer.stop()


@pytest.fixture(scope="module")
def page(viewer: Viewer) -> Iterator[Page]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=GL)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(TIMEOUT)
        page.goto(viewer.url)
        page.get_by_role("button", name="Simulate").wait_for()
        yield page
        browser.close()


@pytest.fixture(scope="module")
def panel(viewer: Viewer, page: Page) -> Panel:
    wait_until(page, lambda: bool(viewer.panels))
    return next(iter(viewer.panels.values()))


def wait_until(page: Page, condition: Callable[[], Any]) -> None:
    deadline = time.monotonic() + TIMEOUT / 1000
    while not condition():
        assert time.monotonic() < deadline
        page.wait_for_timeout(50)


def press(page: Page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def choose(page: Page, label: str, option: str) -> None:
    page.get_by_role("combobox", name=label, exact=True).click()
    page.get_by_role("option", name=option, exact=True).click()


def tab(page: Page, name: str) -> None:
    page.get_by_role("tab", name=name, exact=True).click()


def rendered(page: Page, panel: Panel) -> np.ndarray:
    """The full picture of what the browser's camera sees now."""
    kept: list[np.ndarray] = []
    view, draw = panel.view, panel.view._draw
    panel.ask_picture()
    asked = view._number

    def listen(request: Request, rows: int, number: int, in_bands: bool) -> np.ndarray | None:
        image = draw(request, rows, number, in_bands)
        if image is not None and rows >= request.rows and number > asked:  # not one that was asked for before
            kept.append(image)
        return image

    view._draw = listen
    panel.ask_picture()
    wait_until(page, lambda: kept)
    view._draw = draw
    return kept[-1]


def shades(page: Page) -> np.ndarray:
    """What the browser's screen shows left of the panel (height, width, 3)."""
    picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    return picture[:, 330:930]


def blue_share(image: np.ndarray) -> float:
    """Share of pixels that have the saturated blue of the block's face; floor and page are grey."""
    red, green, blue = (image[..., channel].astype(int) for channel in range(3))
    return float(((blue - red > 60) & (blue - green > 40)).mean())


def test_a_person_plays_selects_deletes_simulates_and_exports(page: Page, panel: Panel, viewer: Viewer) -> None:
    session = panel.session
    page.get_by_text("PSNR").first.wait_for()

    press(page, "Simulate")
    wait_until(page, lambda: session.now.num_steps == 8 and panel.step.value == 8)
    press(page, "start")
    wait_until(page, lambda: panel.step.value == 0)
    press(page, "step")
    wait_until(page, lambda: panel.step.value == 1)
    seen = set()
    press(page, "play")
    wait_until(page, lambda: seen.add(panel.step.value) or len(seen) >= 5)
    press(page, "play")
    press(page, "start")
    wait_until(page, lambda: panel.step.value == 0)

    tab(page, "View")
    choose(page, "show", "rendered")
    with_block = rendered(page, panel)
    wait_until(page, lambda: blue_share(shades(page)) > 0.002)  # the browser draws what was sent
    assert blue_share(with_block) > 0.002

    tab(page, "Edit")
    press(page, "Select cluster")
    wait_until(page, lambda: int(session.selected.sum()) > 100)
    press(page, "Delete")
    wait_until(page, lambda: len(session.operations()) == 1)
    press(page, "Simulate")
    wait_until(page, lambda: session.now.num_steps == 8 and panel.step.value == 8)

    gone = rendered(page, panel)
    assert gone.shape == with_block.shape and blue_share(gone) < 0.05 * blue_share(with_block)
    wait_until(page, lambda: blue_share(shades(page)) < 0.05 * blue_share(with_block))

    tab(page, "Export")
    before = set(viewer_files(viewer))
    press(page, "Export particles")
    wait_until(page, lambda: len(set(viewer_files(viewer)) - before) == 1)
    press(page, "Export film (WebM)")
    wait_until(page, lambda: any(path.suffix == ".webm" for path in viewer_files(viewer)))
    press(page, "Export edit (YAML)")
    wait_until(page, lambda: any(path.suffix == ".yaml" for path in viewer_files(viewer)))
    the_script_deletes_the_same_particles(panel, viewer)
    the_film_has_every_frame_and_plays(page, viewer)


def viewer_files(viewer: Viewer) -> list[Path]:
    folder = next(iter(viewer.panels.values())).folder.folder
    return [path for path in folder.glob("*") if not path.name.startswith(".")]


def the_script_deletes_the_same_particles(panel: Panel, viewer: Viewer) -> None:
    edited = panel.session.now.editor.scene
    assert same(vpd.SceneEditor(viewer.opened.scene).delete(Cluster(0)).scene, edited)
    saved = next(path for path in viewer_files(viewer) if path.suffix == ".yaml")
    assert same(replay(viewer.opened.scene, load_edit(saved)).scene, edited)


def the_film_has_every_frame_and_plays(page: Page, viewer: Viewer) -> None:
    film = next(path for path in viewer_files(viewer) if path.suffix == ".webm")
    reader, count = cv2.VideoCapture(str(film)), 0
    while reader.read()[0]:
        count += 1
    assert count == 9
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


def test_a_rectangle_selects_what_the_camera_sees_in_it(page: Page, panel: Panel) -> None:
    tab(page, "Edit")
    panel.session.select(None)
    page.get_by_label("drag rectangles").click()
    page.get_by_text("Drag a rectangle").wait_for()  # before it is there, dragging moves the camera
    page.mouse.move(340, 20)
    page.mouse.down()
    page.mouse.move(600, 300, steps=5)
    page.mouse.move(925, 780, steps=5)
    page.mouse.up()
    wait_until(page, lambda: int(panel.session.selected.sum()) > 0)
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
    other.get_by_role("button", name="Simulate").wait_for()
    wait_until(other, lambda: len(viewer.panels) == 2)
    second = next(p for p in viewer.panels.values() if p is not panel)
    before = panel.session.now.editor.scene
    press(other, "Select cluster")
    wait_until(other, lambda: int(second.session.selected.sum()) > 100)
    press(other, "Delete")
    wait_until(other, lambda: len(second.session.operations()) == 1)
    assert panel.session.now.editor.scene is before
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
