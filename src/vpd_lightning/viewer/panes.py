"""Labelled pictures side by side in the browser's canvas, and which of them a place of the canvas belongs to."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from vpd_lightning.media.video import label_bar

GROUND = 24
"""Grey level of the ground between and behind the panes."""

SELECTED = (255, 140, 0)
"""Colour of what is selected."""

_GAP, _LABEL = 6, 26  # pixels


@dataclass(frozen=True)
class Layout:
    """Where panes of one size stand in a canvas of ``height`` x ``width`` pixels; a label is above each.

    They may leave the lower part of the canvas free.
    """

    height: int
    width: int
    pane_height: int
    pane_width: int
    corners: tuple[tuple[int, int], ...]  # (top, left) of each pane

    def find(self, x: float, y: float) -> tuple[int, float, float] | None:
        """Return the pane at a place of the canvas, and the place in it; shares of width and height, from (0, 0).

        None between the panes.
        """
        for number, (top, left) in enumerate(self.corners):
            u = (x * self.width - left) / self.pane_width
            v = (y * self.height - top) / self.pane_height
            if 0 <= u < 1 and 0 <= v < 1:
                return number, u, v
        return None


def lay_out(count: int, pane_aspect: float, height: int, width: int) -> Layout:
    """Place ``count`` panes in a row or in a column, whichever makes them larger.

    ``pane_aspect`` is width over height of a pane; the canvas is ``height`` x ``width`` pixels.
    """
    best: tuple[int, bool] | None = None
    for in_row in (True, False):
        columns, rows = (count, 1) if in_row else (1, count)
        high = (height - rows * (_GAP + _LABEL) - _GAP) // rows
        wide = (width - (columns + 1) * _GAP) // columns
        size = max(min(high, int(wide / pane_aspect)), 8)
        if best is None or size > best[0]:
            best = size, in_row
    assert best is not None
    high, in_row = best
    wide = max(round(high * pane_aspect), 8)
    block_height = (high + _LABEL) if in_row else count * (high + _LABEL) + (count - 1) * _GAP
    block_width = count * wide + (count - 1) * _GAP if in_row else wide
    top, left = max((height - block_height) // 2, 0) + _LABEL, max((width - block_width) // 2, 0)
    corners = tuple(
        (top, left + number * (wide + _GAP)) if in_row else (top + number * (high + _LABEL + _GAP), left)
        for number in range(count)
    )
    return Layout(height, width, high, wide, corners)


def compose(
    layout: Layout, images: Sequence[UInt8[NDArray, "_ _ 3"]], labels: Sequence[str]
) -> UInt8[NDArray, "height width 3"]:
    """Return the canvas with an image, enlarged or reduced to its pane, and a label in each pane."""
    canvas = np.full((layout.height, layout.width, 3), GROUND, np.uint8)
    for (top, left), image, label in zip(layout.corners, images, labels, strict=True):
        size = (layout.pane_width, layout.pane_height)
        shrinks = image.shape[0] > layout.pane_height
        scaled = cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
        _paste(canvas, scaled, top, left)
        _paste(canvas, label_bar(label, layout.pane_width, _LABEL), top - _LABEL, left)
    return canvas


def _paste(canvas: UInt8[NDArray, "_ _ 3"], image: UInt8[NDArray, "_ _ 3"], top: int, left: int) -> None:
    high, wide = canvas.shape[0] - top, canvas.shape[1] - left
    canvas[top : top + image.shape[0], left : left + image.shape[1]] = image[:high, :wide]


def tinted(
    image: UInt8[NDArray, "height width 3"], pixels: Float[NDArray, "point 2"], radius: float
) -> UInt8[NDArray, "height width 3"]:
    """Return an image in which discs of ``radius`` around ``pixels`` (x, y) are tinted as selected."""
    covered = np.zeros(image.shape[:2], np.uint8)
    for x, y in np.round(pixels).astype(int).tolist():
        if -radius <= x < image.shape[1] + radius and -radius <= y < image.shape[0] + radius:
            cv2.circle(covered, (x, y), max(round(radius), 1), 1, -1)
    mixed = (0.5 * image + 0.5 * np.array(SELECTED)).astype(np.uint8)
    edge = covered - cv2.erode(covered, np.ones((3, 3), np.uint8))
    result = np.where(covered[..., None] > 0, mixed, image)
    return np.where(edge[..., None] > 0, np.array(SELECTED, np.uint8), result)
