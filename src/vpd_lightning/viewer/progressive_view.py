"""The rendered picture of the browser's camera: coarse at once, full when the camera is still."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.types import Cameras, Particles, Rays
from vpd_lightning.viewer.session import to_uint8

STILL_SECONDS = 0.2
"""A camera that did not move for so long is still."""

COARSE_SECONDS = 0.12
"""What a coarse picture may take; its size follows from how fast pictures were so far."""

_MIN_ROWS, _MAX_ROWS = 24, 1024
_BAND_SECONDS = 0.1


@dataclass(frozen=True)
class Viewpoint:
    """A pinhole camera without a resolution: ``fov`` is vertical (radians), ``aspect`` width over height."""

    cam_to_world: Float[NDArray, "4 4"]
    fov: float
    aspect: float

    def cameras(self, rows: int) -> Cameras:
        """Return the camera (axis ``view`` of 1) with square pixels and so many rows."""
        columns = max(1, round(rows * min(max(self.aspect, 0.1), 10.0)))
        focal = 0.5 * rows / math.tan(0.5 * self.fov)
        intrinsics = torch.tensor([[focal, 0, columns / 2], [0, focal, rows / 2], [0, 0, 1.0]])
        pose = torch.from_numpy(np.asarray(self.cam_to_world, dtype=np.float32))
        return Cameras(intrinsics[None], pose[None], rows, columns)


@dataclass(frozen=True)
class Request:
    """Which states to draw side by side (one, or two to compare), and from where."""

    states: Sequence[Particles]
    viewpoint: Viewpoint
    rows: int  # of the full picture


class ProgressiveView:
    """A thread that draws what was asked for last and gives up on what is out of date.

    ``show`` gets each picture and whether it is the full one.
    """

    def __init__(
        self, renderer: AbstractRenderer, show: Callable[[UInt8[NDArray, "height width 3"], bool], None]
    ) -> None:
        self._renderer, self._show = renderer, show
        self._condition = threading.Condition()
        self._request: Request | None = None
        self._number, self._asked_at, self._stopped = 0, 0.0, False
        self._pixels_per_second = 50_000.0
        self.coarse_seconds: list[float] = []  # from asking to showing, for benchmarks
        self._thread = threading.Thread(target=self._work, daemon=True, name="vpd-view rendering")
        self._thread.start()

    def ask(self, request: Request | None) -> None:
        """Draw this from now on; None draws nothing."""
        with self._condition:
            self._request, self._asked_at = request, time.perf_counter()
            self._number += 1
            self._condition.notify()

    def stop(self) -> None:
        """End the thread."""
        with self._condition:
            self._stopped = True
            self._number += 1
            self._condition.notify()
        self._thread.join(timeout=10)

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
            if request is None:
                continue
            rows = self._coarse_rows(request)
            coarse = self._draw(request, rows, number, in_bands=False)
            if coarse is not None:
                self._show(coarse, rows >= request.rows)
                self.coarse_seconds.append(time.perf_counter() - asked)
            if rows >= request.rows:
                continue
            if self._is_still(number):
                full = self._draw(request, request.rows, number, in_bands=True)
                if full is not None:
                    self._show(full, True)

    def _is_still(self, number: int) -> bool:
        """Wait; whether nothing newer was asked for."""
        with self._condition:
            return not self._condition.wait_for(lambda: self._number != number, timeout=STILL_SECONDS)

    def _coarse_rows(self, request: Request) -> int:
        pixels = COARSE_SECONDS * self._pixels_per_second
        rows = int(math.sqrt(pixels / max(request.viewpoint.aspect, 0.1)))
        return min(max(rows, _MIN_ROWS), request.rows, _MAX_ROWS)

    def _draw(
        self, request: Request, rows: int, number: int, in_bands: bool
    ) -> UInt8[NDArray, "height width 3"] | None:
        """Render all states side by side; None where something newer was asked for in between."""
        view = request.viewpoint
        share = Viewpoint(view.cam_to_world, view.fov, view.aspect / len(request.states))
        pictures = [self._picture(state, share.cameras(rows), number, in_bands) for state in request.states]
        found = [picture for picture in pictures if picture is not None]
        return np.concatenate(found, axis=1) if len(found) == len(pictures) else None

    @torch.no_grad()
    def _picture(
        self, state: Particles, cameras: Cameras, number: int, in_bands: bool
    ) -> UInt8[NDArray, "height width 3"] | None:
        rays = pixel_rays(cameras.to(state.positions.device, state.positions.dtype))
        origins, directions = rays.origins[0].flatten(0, 1), rays.directions[0].flatten(0, 1)
        band = max(cameras.width, int(_BAND_SECONDS * self._pixels_per_second)) if in_bands else len(origins)
        parts = []
        for first in range(0, len(origins), band):
            if in_bands and number != self._number:
                return None
            piece = slice(first, first + band)
            start = time.perf_counter()
            rendered = self._renderer(state, Rays(origins[piece][None], directions[piece][None]), None)
            parts.append(rendered.rgbs[0])
            rate = len(origins[piece]) / max(time.perf_counter() - start, 1e-6)
            self._pixels_per_second = 0.5 * self._pixels_per_second + 0.5 * rate
        return to_uint8(torch.cat(parts).reshape(cameras.height, cameras.width, 3))
