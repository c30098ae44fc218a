"""How fast the viewer answers, with the released demo: ``python -m benchmarks.viewer_speed``.

``first picture``: from starting ``vpd-view`` until a browser that runs already shows the particles as they were
observed; ``first figures``: until they have the renderer's colours, with figures beside them. ``coarse picture``: from
the camera's move until the picture goes to the browser. ``step``: one simulated step while each is shown.
``selection``: 10,000 particles by box and lasso. The browser (Debian's chromium) draws in software on the same cores.
``--screenshots FOLDER`` keeps two pictures of the page.
"""

import argparse
import json
import math
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.results_files import default_folder, versions

MODEL = "released/mujoco_block_demo"
CHROMIUM_ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
TARGETS = {"first picture": 5.0, "first figures": None, "coarse picture": 0.3, "step": 0.2, "selection": 0.05}


def open_browser(playwright: Any) -> Any:
    """Start Debian's chromium."""
    path = shutil.which("chromium") or shutil.which("google-chrome")
    return playwright.chromium.launch(executable_path=path, args=CHROMIUM_ARGUMENTS)


def first_picture(browser: Any) -> tuple[float, float]:
    """Return the seconds from starting the command until particles are shown, and until figures are."""
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    command = [sys.executable, "-m", "vpd_lightning.commands.view", f"ckpt={MODEL}", "port=0"]
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        url = next(found.group() for line in process.stdout if (found := re.search(r"http://127\S+", line)))
        page.goto(url)
        # The page handles messages in order, and the panel's title is sent behind the points.
        page.get_by_text("frame 0").first.wait_for(timeout=120_000)
        particles = time.perf_counter() - start
        page.get_by_text("PSNR").first.wait_for(timeout=120_000)
        return particles, time.perf_counter() - start
    finally:
        process.terminate()
        process.wait(60)
        page.close()


def in_the_browser(browser: Any, screenshots: Path | None) -> dict[str, list[float]]:
    """Return seconds of coarse pictures while the camera is dragged, and of steps while they are shown."""
    from vpd_lightning.commands.view import start
    from vpd_lightning.config import compose

    viewer = start(compose("view", [f"ckpt={MODEL}", "port=0", "start_frame=4"]))
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(viewer.url)
    page.get_by_text("PSNR").first.wait_for(timeout=120_000)
    panel = next(iter(viewer.panels.values()))
    if screenshots is not None:
        page.get_by_role("button", name="Select cluster").click()
        page.wait_for_timeout(3000)
        page.screenshot(path=screenshots / "viewer_selection.png")
    steps = []
    for _ in range(2):
        panel.session.now.states[1:] = []
        begin = time.perf_counter()
        page.get_by_role("button", name="Simulate", exact=True).click()
        while panel.session.now.num_steps < 32 or panel._busy.locked():
            page.wait_for_timeout(10)
        steps.append((time.perf_counter() - begin) / 32)
    panel.step.value = 6
    page.get_by_role("tab", name="View").click()
    page.get_by_role("combobox", name="show", exact=True).click()
    page.get_by_role("option", name="rendered").click()
    page.wait_for_timeout(4000)
    if screenshots is not None:
        page.screenshot(path=screenshots / "viewer_rendered.png")
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
    return {"coarse picture": coarse, "step": steps}


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


def main() -> None:
    """Measure, print a table and write ``viewer_cpu.json``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--screenshots", type=Path)
    parser.add_argument("--out", type=Path, default=default_folder())
    options = parser.parse_args()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = open_browser(playwright)
        firsts = [first_picture(browser) for _ in range(3)]
        seconds = {"first picture": [a for a, _ in firsts], "first figures": [b for _, b in firsts]}
        seconds |= in_the_browser(browser, options.screenshots)
        browser.close()
    seconds["selection"] = selections()
    rows = []
    for name, values in seconds.items():
        ordered = sorted(values)
        rows.append({
            "name": name, "median": ordered[len(ordered) // 2], "largest": ordered[-1], "count": len(ordered),
            "target": TARGETS[name],
        })  # fmt: skip
        print(f"{name:16s} median {rows[-1]['median']:.3f} s, largest {ordered[-1]:.3f} s of {len(ordered)}")
    content = {
        "model": MODEL,
        "device": "cpu",
        "threads": torch.get_num_threads(),
        "versions": versions(),
        "rows": rows,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "viewer_cpu.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
