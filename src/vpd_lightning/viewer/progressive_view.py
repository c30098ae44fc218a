"""Pictures of the rollout: coarse at once, full when the camera is still, and then those of the steps to come."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray

from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.types import Cameras, Particles, Rays
from vpd_lightning.viewer.frame_cache import FrameCache
from vpd_lightning.viewer.session import to_uint8
from vpd_lightning.viewer.viewpoints import Viewpoint

STILL_SECONDS = 0.2
"""A camera that did not move for so long is still."""

COARSE_SECONDS = 0.12
"""What a coarse picture may take; its size follows from how fast pictures were so far."""

_MIN_ROWS, _MAX_ROWS = 24, 1024
_BAND_SECONDS = 0.1

MIN_BAND = 4096
"""Rays of a band, or more: each call of a renderer has costs that do not grow with its rays."""


Pictures = Sequence[UInt8[NDArray, "_ _ 3"]]


@dataclass(frozen=True)
class Pane:
    """A state to draw: step ``step`` of the rollout ``number``."""

    number: int
    step: int
    state: Particles


@dataclass(frozen=True)
class Request:
    """Which states to draw (one, or two to compare), from where, and what to draw next where that is done.

    ``rows`` are those of a full picture. ``film`` returns what will be asked for next, in that order.
    """

    panes: Sequence[Pane]
    viewpoint: Viewpoint
    rows: int
    film: Callable[[], Sequence["Request"]] = tuple

    def shows_same_scenes(self, other: "Request | None") -> bool:
        """Whether both draw the same rollouts by the same kind of camera, which may have moved."""
        return (
            other is not None
            and type(self.viewpoint) is type(other.viewpoint)
            and [pane.number for pane in self.panes] == [pane.number for pane in other.panes]
        )

    def shows_like(self, other: "Request | None") -> bool:
        """Whether the pictures of both belong to the same film."""
        return (
            other is not None
            and self.shows_same_scenes(other)
            and (self.rows, self.viewpoint.key) == (other.rows, other.viewpoint.key)
        )


class ProgressiveView:
    """A thread that draws what was asked for last and gives up on what is out of date; full pictures are kept.

    ``show`` gets the request, a picture for each of its panes, and whether they are full ones.
    """

    def __init__(
        self,
        renderer: AbstractRenderer,
        show: Callable[[Request, Pictures, bool], None],
        frames: FrameCache | None = None,
    ) -> None:
        self._renderer, self._show = renderer, show
        self._frames = FrameCache() if frames is None else frames
        self._condition, self._showing = threading.Condition(), threading.Lock()
        self._request: Request | None = None
        self._finished: Request | None = None  # of which the full pictures were shown last
        self._number, self._asked_at, self._stopped, self._film_grew = 0, 0.0, False, False
        self._pixels_per_second = 50_000.0
        self.coarse_seconds: list[float] = []  # from asking to showing, for benchmarks
        self._thread = threading.Thread(target=self._work, daemon=True, name="vpd-view rendering")
        self._thread.start()

    def ask(self, request: Request | None) -> None:
        """Draw this from now on; None draws nothing. What is kept is shown before this returns."""
        kept = None if request is None else self._kept(request)
        with self._condition:
            goes_on = kept is not None and request is not None and request.shows_like(self._request)
            self._request, self._asked_at = request, time.perf_counter()
            if not goes_on:
                self._number += 1
            self._condition.notify()
        if request is not None and kept is not None:
            self._show_if_current(request, kept, True)

    def is_ready(self, request: Request) -> bool:
        """Whether the full pictures of a request are kept."""
        return self._kept(request) is not None

    def draw(self, request: Request) -> Pictures:
        """Return the full pictures of a request, drawn here and now where they are not kept."""
        kept = self._kept(request)
        if kept is not None:
            return kept
        pictures = self._draw(request, request.rows, number=None, in_bands=True)
        assert pictures is not None  # nothing makes it out of date
        return pictures

    def film_grew(self) -> None:
        """Look again whether the film that was asked for has more steps."""
        with self._condition:
            self._film_grew = True
            self._condition.notify()

    def stop(self) -> None:
        """End the thread."""
        with self._condition:
            self._stopped = True
            self._number += 1
            self._condition.notify()
        self._thread.join(timeout=10)

    def _kept(self, request: Request) -> Pictures | None:
        found = [self._frames.get(_key(request, pane)) for pane in request.panes]
        kept = [image for image in found if image is not None]
        return kept if len(kept) == len(found) else None

    def _show_if_current(self, request: Request, pictures: Pictures, is_full: bool) -> None:
        with self._showing:
            latest = self._request
            # While a camera moves, the picture of a moment ago is better than none.
            serves = not is_full and latest is not None and self._kept(latest) is None
            if request is latest or (serves and request.shows_same_scenes(latest)):
                self._show(request, pictures, is_full)
                self._finished = request if is_full else None

    def _work(self) -> None:
        done = 0
        while True:
            with self._condition:
                while not self._stopped and self._number == done:
                    self._condition.wait()
                if self._stopped:
                    return
                number, request, asked = self._number, self._request, self._asked_at
            done = number
            if request is not None and self._draw_asked(request, number, asked):
                self._fill(number)

    def _draw_asked(self, request: Request, number: int, asked: float) -> bool:
        """Show what was asked for, coarse and then full; False where something newer was asked for in between."""
        kept = self._kept(request)
        if kept is not None:
            if self._finished is not request:  # drawn after it was asked for, for an older request
                self._show_if_current(request, kept, True)
            return self._is_still(number)
        rows = self._coarse_rows(request)
        coarse = self._draw(request, rows, number, in_bands=False)
        if coarse is not None:
            self._show_if_current(request, coarse, rows >= request.rows)
            self.coarse_seconds.append(time.perf_counter() - asked)
        if not self._is_still(number):
            return False
        if rows < request.rows:
            full = self._draw(request, request.rows, number, in_bands=True)
            if full is None:
                return False
            self._show_if_current(request, full, True)
        return True

    def _fill(self, number: int) -> None:
        """Draw the steps to come, until something else is asked for."""
        while True:
            with self._condition:
                request, self._film_grew = self._request, False
                if number != self._number or request is None:
                    return
            missing = next((other for other in request.film() if self._kept(other) is None), None)
            if missing is not None:
                self._draw(missing, missing.rows, number, in_bands=True)
                continue
            with self._condition:
                self._condition.wait_for(lambda: self._number != number or self._film_grew)

    def _is_still(self, number: int) -> bool:
        """Wait; whether nothing newer was asked for."""
        with self._condition:
            return not self._condition.wait_for(lambda: self._number != number, timeout=STILL_SECONDS)

    def _coarse_rows(self, request: Request) -> int:
        pixels = COARSE_SECONDS * self._pixels_per_second / len(request.panes)
        cameras = request.viewpoint.cameras(_MIN_ROWS)
        rows = int(math.sqrt(pixels * cameras.height / cameras.width))
        return min(max(rows, _MIN_ROWS), request.rows, _MAX_ROWS)

    def _draw(self, request: Request, rows: int, number: int | None, in_bands: bool) -> Pictures | None:
        """Render all states; None where something newer than ``number`` was asked for in between."""
        cameras, pictures = request.viewpoint.cameras(rows), []
        for pane in request.panes:
            key = _key(request, pane)
            picture = self._frames.get(key) if rows >= request.rows else None
            if picture is None:
                picture = self._picture(pane.state, cameras, number, in_bands)
                if picture is None:
                    return None
                if rows >= request.rows:
                    self._frames.put(key, picture)
            pictures.append(picture)
        return pictures

    @torch.no_grad()
    def _picture(
        self, state: Particles, cameras: Cameras, number: int | None, in_bands: bool
    ) -> UInt8[NDArray, "height width 3"] | None:
        rays = pixel_rays(cameras.to(state.positions.device, state.positions.dtype))
        origins, directions = rays.origins[0].flatten(0, 1), rays.directions[0].flatten(0, 1)
        band = max(MIN_BAND, int(_BAND_SECONDS * self._pixels_per_second)) if in_bands else len(origins)
        parts = []
        for first in range(0, len(origins), band):
            if in_bands and number is not None and number != self._number:
                return None
            piece = slice(first, first + band)
            start = time.perf_counter()
            rendered = self._renderer(state, Rays(origins[piece][None], directions[piece][None]), None)
            parts.append(rendered.rgbs[0])
            rate = len(origins[piece]) / max(time.perf_counter() - start, 1e-6)
            self._pixels_per_second = 0.5 * self._pixels_per_second + 0.5 * rate
        return np.array(to_uint8(torch.cat(parts).reshape(cameras.height, cameras.width, 3)))


def _key(request: Request, pane: Pane) -> tuple[object, ...]:
    return (pane.number, pane.step, request.viewpoint.key, request.rows)
