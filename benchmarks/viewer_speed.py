"""How fast the viewer answers, with the released demo: ``python -m benchmarks.viewer_speed [--before CHECKOUT]``.

A browser (Debian's chromium, which draws in software on the same cores) does what a visitor does, and a stopwatch runs
until its screen shows the result. With ``--before`` the viewer of an older checkout (when the page opened on particles)
is driven through the same, in turn with ours. Rows, in seconds:

* ``address``: from starting ``vpd-view`` until it prints its address; the rows below count from opening that address;
* ``first picture``: until the block is on the screen; ``motion``: until it was seen to move (the older page has to be
  told to simulate, to render and to play); ``second tab``: the first picture of a second browser;
* ``edit``: from the click that takes the block away until it is gone from the screen; ``32 steps``: until the edited
  scene is simulated;
* ``film``: 33 frames, from the click until the file is there, of what is on the screen; ``film, free camera``: the same
  at 256 rows from a camera that nothing was drawn for yet;
* ``coarse picture``: from a camera's move until its picture goes to the browser; ``step``: one simulated step;
  ``selection``: 10,000 particles by box and lasso. These three are ours alone, in this process.

``--screenshots FOLDER`` keeps pictures of the page.
"""

import argparse
import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.results_files import default_folder, versions

MODEL = "released/mujoco_block_demo"
CHROMIUM_ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
TARGETS = {"motion": 6.0, "coarse picture": 0.3, "step": 0.2, "selection": 0.05}
LIMIT = 60_000  # milliseconds for anything
REPEATS = 3
_BLOCK = 400  # pixels


class Visit:
    """A browser's page on a viewer of its own."""

    def __init__(self, browser: Any, checkout: Path, data: Path):
        command = [sys.executable, "-m", "vpd_lightning.commands.view", f"ckpt={MODEL}", "port=0"]
        environment = os.environ | {"PYTHONPATH": str(checkout / "src")}
        start = time.perf_counter()
        self.process = subprocess.Popen(
            [*command, f"data.folder={data}"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
        )
        assert self.process.stdout is not None
        self.url = next(found.group() for line in self.process.stdout if (found := re.search(r"http://127\S+", line)))
        self.seconds = {"address": time.perf_counter() - start}
        self.browser = browser
        self.page = self._open()
        self.seconds["first picture"] = self.until(lambda: self.has_block(self.page))

    def _open(self) -> Any:
        page = self.browser.new_page(viewport={"width": 1280, "height": 800}, accept_downloads=True)
        page.set_default_timeout(LIMIT)
        self.start = time.perf_counter()
        page.goto(self.url)
        return page

    def until(self, condition: Callable[[], Any]) -> float:
        """Return the seconds since ``start`` when the condition holds."""
        while not condition():
            assert time.perf_counter() - self.start < LIMIT / 1000
            self.page.wait_for_timeout(20)
        return time.perf_counter() - self.start

    def blue(self, page: Any, from_x: float = 0.0) -> Any:
        """Return where the screen, left of the panel, has the blue of the block's faces; panes right of ``from_x``."""
        shown = page.screenshot(clip={"x": 0, "y": 0, "width": 950, "height": 800})
        picture = cv2.imdecode(np.frombuffer(shown, np.uint8), cv2.IMREAD_COLOR).astype(int)
        shade, green, red = (picture[:, int(from_x * 950) : 950, channel] for channel in range(3))
        return (shade - red > 60) & (shade - green > 40)

    def has_block(self, page: Any, from_x: float = 0.0) -> bool:
        """Whether the block is on the screen; gizmos and drawn cameras have few blue pixels."""
        return bool(self.blue(page, from_x).sum() > _BLOCK)

    def motion(self) -> float:
        """Return the seconds until the block was seen to move."""
        places: list[float] = []

        def moved() -> bool:
            rows, _ = np.nonzero(self.blue(self.page))
            if len(rows) > 20:
                places.append(float(np.median(rows)))
            return len(places) > 1 and max(places) - min(places) > 15

        return self.until(moved)

    def press(self, name: str) -> None:
        """Click a button."""
        self.page.get_by_role("button", name=name, exact=True).click()

    def tab(self, name: str) -> None:
        """Show a tab of the panel."""
        self.page.get_by_role("tab", name=name, exact=True).click()

    def show(self, what: str) -> None:
        """Choose what is shown."""
        self.tab("View")
        self.page.get_by_role("combobox", name="show", exact=True).click()
        self.page.get_by_role("option", name=what).click()

    def second_tab(self) -> None:
        """Time the first picture of another browser."""
        other = self._open()
        self.seconds["second tab"] = self.until(lambda: self.has_block(other))
        other.close()

    def film(self, row: str, button: str, is_downloaded: bool) -> None:
        """Time a film of the rollout."""
        self.start = time.perf_counter()
        if is_downloaded:
            with self.page.expect_download() as coming:
                self.press(button)
            coming.value.path()
        else:
            self.press(button)
            self.page.get_by_text("Written").first.wait_for()
        self.seconds[row] = time.perf_counter() - self.start

    def __enter__(self) -> "Visit":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self.process.wait(60)


def visit_ours(browser: Any, data: Path, screenshots: Path | None) -> dict[str, float]:
    """Drive the page of this checkout."""
    with Visit(browser, Path(__file__).parents[1], data) as visit:
        _ours(visit, screenshots)
        visit.page.close()
        return visit.seconds


def _ours(visit: Visit, screenshots: Path | None) -> None:
    page = visit.page
    visit.seconds["motion"] = visit.motion()
    page.get_by_text("of 32").first.wait_for()
    page.wait_for_timeout(15_000)  # the film is drawn meanwhile
    _picture(page, screenshots, "viewer_film")
    visit.second_tab()
    visit.tab("Save")
    visit.film("film", "Save film", True)
    visit.start = time.perf_counter()
    visit.press("Take the block away")
    visit.seconds["edit"] = visit.until(lambda: not visit.has_block(page, from_x=0.5))
    page.get_by_text("of 32").first.wait_for()
    visit.seconds["32 steps"] = time.perf_counter() - visit.start
    page.wait_for_timeout(15_000)
    visit.press("Pause")
    page.wait_for_timeout(1000)
    _picture(page, screenshots, "viewer_compare")
    visit.press("Start over")
    page.wait_for_timeout(2000)
    visit.press("Pause")
    visit.show("free camera")
    page.wait_for_timeout(3000)
    visit.tab("Save")
    visit.film("film, free camera", "Save film", True)


def visit_before(browser: Any, data: Path, checkout: Path, screenshots: Path | None) -> dict[str, float]:
    """Drive the page of the older checkout."""
    with Visit(browser, checkout, data) as visit:
        _before(visit, screenshots)
        visit.page.close()
        return visit.seconds


def _before(visit: Visit, screenshots: Path | None) -> None:
    page, opened = visit.page, visit.start
    visit.press("Simulate")
    page.get_by_text("of 32").first.wait_for()
    visit.show("rendered")
    visit.press("start")
    visit.press("play")
    visit.start = opened
    visit.seconds["motion"] = visit.motion()
    visit.press("play")
    visit.press("start")
    _picture(page, screenshots, "viewer_before")
    visit.second_tab()
    visit.tab("Export")
    visit.film("film, free camera", "Export film (WebM)", False)
    visit.tab("Edit")
    visit.press("Select cluster")
    page.wait_for_timeout(1000)
    visit.start = time.perf_counter()
    visit.press("Delete")
    visit.seconds["edit"] = visit.until(lambda: not visit.has_block(page))
    visit.start = time.perf_counter()
    visit.press("Simulate")
    page.get_by_text("of 32").first.wait_for()
    visit.seconds["32 steps"] = time.perf_counter() - visit.start


def _picture(page: Any, folder: Path | None, name: str) -> None:
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        page.screenshot(path=folder / f"{name}.png")


def in_this_process(browser: Any, data: Path) -> dict[str, list[float]]:
    """Return seconds of coarse pictures while the camera is dragged, and of steps while they are drawn."""
    from vpd_lightning.commands.view import start
    from vpd_lightning.config import compose

    viewer = start(compose("view", [f"ckpt={MODEL}", "port=0", f"data.folder={data}"]))
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    begin = time.perf_counter()
    page.goto(viewer.url)
    page.get_by_text("of 32").first.wait_for(timeout=LIMIT)
    panel = next(iter(viewer.panels.values()))
    steps = [(time.perf_counter() - begin) / 32]
    for _ in range(2):
        begin = time.perf_counter()
        panel.presets._throw(0, "block")
        while panel.session.now.num_steps < 32:
            page.wait_for_timeout(10)
        steps.append((time.perf_counter() - begin) / 32)
    panel.start_over()
    panel.set_playing(False)
    panel.set_mode("free camera")
    page.wait_for_timeout(4000)
    panel.view.coarse_seconds.clear()
    page.mouse.move(400, 400)
    page.mouse.down()
    for move in range(40):
        page.mouse.move(400 + 4 * move, 400 + 60 * math.sin(move / 6))
        page.wait_for_timeout(60)
    page.mouse.up()
    page.wait_for_timeout(1500)
    coarse = list(panel.view.coarse_seconds)
    page.close()
    viewer.stop()
    return {"coarse picture": coarse, "step": steps[1:]}


def selections() -> list[float]:
    """Return the slower of box and lasso on 10,000 particles, five times."""
    from vpd_lightning.editing.scene_editor import SceneEditor
    from vpd_lightning.editing.selectors import Box, Lasso
    from vpd_lightning.simulator import Scene
    from vpd_lightning.types import Particles

    frame = Particles(torch.rand(1, 10_000, 3, generator=torch.Generator().manual_seed(0)), torch.zeros(1, 10_000, 4))
    editor = SceneEditor(Scene(frame, frame))
    circle = [[50 + 40 * math.cos(a / 10), 50 + 40 * math.sin(a / 10)] for a in range(63)]
    lasso = Lasso([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]], torch.eye(4).tolist(), circle)
    seconds = []
    for _ in range(5):
        times = []
        for what in (Box([0, 0, 0], [0.5, 0.5, 0.5]), lasso):
            begin = time.perf_counter()
            editor.select(what)
            times.append(time.perf_counter() - begin)
        seconds.append(max(times))
    return seconds


def _rows(visits: list[dict[str, float]], others: dict[str, list[float]]) -> list[dict[str, Any]]:
    seconds = {name: [visit[name] for visit in visits] for name in (visits[0] if visits else {})} | others
    rows = []
    for name, values in seconds.items():
        ordered = sorted(values)
        row = {"name": name, "median": ordered[len(ordered) // 2], "largest": ordered[-1], "count": len(ordered)}
        rows.append(row | {"target": TARGETS.get(name)})
    return rows


def main() -> None:
    """Measure, print a table and write ``viewer_cpu.json``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path)
    parser.add_argument("--data", type=Path, default=Path("datasets/mujoco_block_demo"))
    parser.add_argument("--screenshots", type=Path)
    parser.add_argument("--out", type=Path, default=default_folder())
    options = parser.parse_args()
    from playwright.sync_api import sync_playwright

    data = options.data.resolve()
    with sync_playwright() as playwright:
        path = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=path, args=CHROMIUM_ARGUMENTS)
        ours, before = [], []
        for _ in range(REPEATS):
            if options.before is not None:
                before.append(visit_before(browser, data, options.before.resolve(), options.screenshots))
            ours.append(visit_ours(browser, data, options.screenshots))
        others = in_this_process(browser, data)
        browser.close()
    content = {
        "model": MODEL, "device": "cpu", "threads": torch.get_num_threads(), "versions": versions(),
        "rows": _rows(ours, others | {"selection": selections()}),
    }  # fmt: skip
    if before:
        content["before"] = _rows(before, {})
    old = {row["name"]: f"{row['median']:8.2f}" for row in content.get("before", [])}
    print(f"{'':20s}{'before':>8s}{'now':>8s}{'largest':>8s}  seconds")
    for row in content["rows"]:
        print(f"{row['name']:20s}{old.get(row['name'], ''):>8s}{row['median']:8.2f}{row['largest']:8.2f}")
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "viewer_cpu.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
