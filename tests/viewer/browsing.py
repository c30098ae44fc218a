"""What a visitor of the viewer does in a browser, and what the browser shows."""

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import torch
from playwright.sync_api import Page

from tests.waiting import HANG
from vpd_lightning.editing.selectors import Cluster
from vpd_lightning.geometry.cameras import project
from vpd_lightning.viewer.panel import Panel

TIMEOUT = 1000 * HANG  # milliseconds
AGAIN = 20.0  # seconds after which a gesture without effect is made again
STEPS = 8


def is_drawn(panel: Panel) -> bool:
    """Whether the whole film is drawn, as finely as it gets."""
    requests = [panel.request(step) for step in range(STEPS + 1)]
    return all(
        request is not None and request.rows == panel.screen.film_rows[-1] and panel.view.is_ready(request)
        for request in requests
    )


def wait_until(page: Page, condition: Callable[[], Any]) -> None:
    deadline = time.monotonic() + TIMEOUT / 1000
    while not condition():
        assert time.monotonic() < deadline
        page.wait_for_timeout(50)


def repeat_until(page: Page, gesture: Callable[[], None], condition: Callable[[], Any]) -> None:
    """Do what a visitor does, and again where it has no effect: a busy page misses a gesture, or a notice gets it."""
    deadline = time.monotonic() + TIMEOUT / 1000
    while not condition():
        gesture()
        patience = time.monotonic() + AGAIN
        while not condition() and time.monotonic() < patience:
            assert time.monotonic() < deadline
            page.wait_for_timeout(50)


def drag(page: Page, *places: tuple[float, float]) -> None:
    """Press the mouse at the first place, and let go at the last."""
    page.mouse.move(*places[0])
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*place, steps=5)
    page.mouse.up()


def press(page: Page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def choose(page: Page, label: str, option: str) -> None:
    page.get_by_role("combobox", name=label, exact=True).click()
    page.get_by_role("option", name=option, exact=True).click()


def tab(page: Page, name: str) -> None:
    page.get_by_role("tab", name=name, exact=True).click()


# What the browser shows


def canvas(page: Page, panel: Panel) -> np.ndarray:
    """The browser's canvas, left of the panel (height, width, 3)."""
    picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    camera = panel.client.camera
    return picture[: camera.image_height, : camera.image_width]


def box(panel: Panel, number: int, count: int) -> tuple[float, float, float, float]:
    """Left, top, width and height of a pane in the canvas (pixels)."""
    layout = panel.screen._layout(count, 1.0)
    scale = panel.client.camera.image_height / layout.height
    top, left = layout.corners[number]
    return left * scale, top * scale, layout.pane_width * scale, layout.pane_height * scale


def pane(page: Page, panel: Panel, number: int, count: int) -> np.ndarray:
    """One pane of what the browser shows."""
    left, top, width, height = (round(value) for value in box(panel, number, count))
    return canvas(page, panel)[top : top + height, left : left + width]


def blue(image: np.ndarray) -> np.ndarray:
    """Pixels with the saturated blue of the block's faces; floor and page are grey."""
    red, green, other = (image[..., channel].astype(int) for channel in range(3))
    return (other - red > 60) & (other - green > 40)


def block_on_screen(image: np.ndarray) -> np.ndarray:
    """Middle of the block's blue faces in a pane: shares of its width and height."""
    rows, columns = np.nonzero(blue(image))
    return np.array([columns.mean() / image.shape[1], rows.mean() / image.shape[0]])


def block_by_camera(panel: Panel, rollout: Any, step: int) -> np.ndarray:
    """Where the film's camera sees the middle of the block's particles: shares of width and height."""
    state = rollout.states[step]
    chosen = rollout.editor.select(Cluster(0))
    cameras = panel.opened.cameras[panel.screen.view]
    pixels, _ = project(state.positions[0][chosen].double(), cameras.to(torch.float64))
    return (pixels.mean(dim=0) / torch.tensor([cameras.width, cameras.height])).numpy()


def click_block(page: Page, panel: Panel, number: int, count: int) -> None:
    """Click the block in a pane, which selects it."""
    left, top, width, height = box(panel, number, count)
    x, y = block_by_camera(panel, panel.session.now, int(panel.step.value))
    click = (left + x * width, top + y * height)
    repeat_until(page, lambda: page.mouse.click(*click), lambda: int(panel.session.selected.sum()) > 100)
