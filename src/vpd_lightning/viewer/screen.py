"""What stands in a browser's canvas: the film of a recorded camera, or the picture of the browser's own."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
import viser
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.geometry.cameras import pixel_rays, project
from vpd_lightning.media.video import error_image
from vpd_lightning.types import Cameras
from vpd_lightning.viewer.exports import as_pose
from vpd_lightning.viewer.panes import GROUND, Layout, compose, lay_out, tinted
from vpd_lightning.viewer.picking import body_at, spacing
from vpd_lightning.viewer.progressive_view import Pane, Pictures, Request
from vpd_lightning.viewer.rollout import Rollout
from vpd_lightning.viewer.session import Session
from vpd_lightning.viewer.viewpoints import FreeViewpoint, RecordedViewpoint, Viewpoint

FILM, PICTURE, PARTICLES = "film", "free camera", "particles"
MODES = (FILM, PICTURE, PARTICLES)

FILM_ROWS = 128
"""Smaller images are rendered at twice their size or more, up to so many rows."""

_MAX_ROWS = 720  # of what is sent to the browser
_NARROW, _FREE_OF_PANEL = 576, 0.4
"""A canvas of so few columns (CSS pixels) is a telephone's: the panel lies over all but this share at its top."""

_UNKNOWN_SIZE = (720, 960)  # of a browser that reports no size


class Screen:
    """Draws one session into one browser's canvas.

    ``mode`` is one of ``MODES``; ``view`` the recorded camera of the film, ``rows`` the rows of a free picture, and
    ``compares`` whether an edited scene stands beside what it is compared with, and ``shows_true`` whether beside what
    the generator's own simulation makes of the edit, where that is known.
    """

    def __init__(self, client: viser.ClientHandle, session: Session):
        self.client, self.session = client, session
        self.mode, self.compares, self.shows_true = FILM, True, True
        self.view, self.rows = session.opened.input_views[0], 256
        self.last_shown: UInt8[NDArray, "_ _ 3"] | None = None

    # What to draw

    @property
    def film_rows(self) -> tuple[int, ...]:
        """Rows of the pictures of the film: first those of the recording, then more where that is small."""
        height = self.session.opened.cameras.height
        return (height,) if height >= FILM_ROWS else (height, height * -(-FILM_ROWS // height))

    def rollouts(self) -> list[Rollout]:
        """Return what is predicted in the panes: the edited scene, after what it is compared with."""
        other = self.session.other if self.compares else None
        return [self.session.now] if other is None else [other, self.session.now]

    def viewpoint(self) -> Viewpoint:
        """Return the camera of one pane."""
        if self.mode == FILM:
            return RecordedViewpoint(self.session.opened.cameras[self.view : self.view + 1], self.view)
        height, width = self._canvas()
        count = len(self.rollouts())
        if count == 1:
            return self.free_viewpoint()
        aspect = width / count / height if width > height else width / (height / count)
        return self.free_viewpoint(aspect)

    def free_viewpoint(self, aspect: float | None = None) -> FreeViewpoint:
        """Return the browser's camera; ``aspect`` is that of the browser where None."""
        camera = self.client.camera
        pose = as_pose(camera.wxyz, camera.position)
        return FreeViewpoint(pose, float(camera.fov), float(camera.aspect) if aspect is None else aspect)

    def request(self, step: int, num_steps: int, is_kept: Callable[[Request], bool]) -> Request | None:
        """Return what to draw of a step and of those that follow in a film of ``num_steps`` steps; None: no picture.

        All pictures of a film have the same size: the finest, once all of them are kept.
        """
        if self.mode == PARTICLES:
            return None
        rollouts, viewpoint = self.rollouts(), self.viewpoint()
        sizes = self.film_rows if self.mode == FILM else (self.rows,)

        def film() -> Sequence[Request]:
            simulated = min(num_steps, *(rollout.num_steps for rollout in rollouts), num_steps)
            order = [*range(step, simulated + 1), *range(min(step, simulated + 1))]
            return [Request(_panes(rollouts, later), viewpoint, rows) for rows in sizes for later in order]

        finest = [Request(_panes(rollouts, later), viewpoint, sizes[-1]) for later in range(num_steps + 1)]
        rows = sizes[-1] if all(is_kept(other) for other in finest) else sizes[0]
        return Request(_panes(rollouts, step), viewpoint, rows, film)

    # What was drawn

    def show(self, request: Request, pictures: Pictures, is_full: bool) -> None:
        """Send the pictures of a request to the browser, with labels where there are several."""
        if self.mode == PARTICLES:
            return
        canvas = self.composed(request, pictures)
        self.last_shown = canvas
        self.client.scene.set_background_image(canvas, format="jpeg", jpeg_quality=90 if is_full else 75)

    def clear(self) -> None:
        """Show no picture."""
        self.client.scene.set_background_image(None)

    def composed(self, request: Request, pictures: Pictures) -> UInt8[NDArray, "_ _ 3"]:
        """Return the canvas with the pictures of a request."""
        cameras = request.viewpoint.cameras(request.rows)
        images = [self._marked(pane, cameras, image) for pane, image in zip(request.panes, pictures, strict=True)]
        if self.mode != FILM and len(images) == 1:
            return images[0]
        labels = [self.session.label(rollout) for rollout in self.rollouts()][-len(images) :]
        if self.mode == FILM and len(images) == 1 and not self.session.now.is_edited:
            labels = ["predicted"]
            truth, error = self._truth(request.panes[0].step, pictures[0])
            images, labels = [truth, images[0], error], ["recorded", *labels, "error"]
        elif (true_picture := self.true_picture(request.panes[-1].step)) is not None:
            images, labels = [*images, true_picture], [*labels, f"MuJoCo: {labels[-1]}"]
        return compose(self._layout(len(images), cameras.width / cameras.height), images, labels)

    def true_picture(self, step: int) -> UInt8[NDArray, "height width 3"] | None:
        """Return what the generator's own simulation shows of an edited scene; None where that is not known."""
        pictures = self.session.now.true_pictures
        if self.mode != FILM or not self.shows_true or pictures is None or step >= len(pictures):
            return None
        return pictures[step, self.view]

    def _truth(self, step: int, picture: UInt8[NDArray, "_ _ 3"]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        opened = self.session.opened
        if not self.session.has_truth(step):
            nothing = np.full((8, 8, 3), GROUND, np.uint8)
            return nothing, nothing
        truth = opened.truth[step, self.view]
        return truth, error_image(self.as_recorded(picture), truth)

    def film_picture(self, step: int) -> UInt8[NDArray, "_ _ 3"] | None:
        """Return the picture of the film of the edited scene at a step, None where it is not drawn."""
        key = (self.session.now.number, step, self.view, self.film_rows[0])
        return self.session.opened.frames.get(key)

    def as_recorded(self, picture: UInt8[NDArray, "_ _ 3"]) -> UInt8[NDArray, "height width 3"]:
        """Return a picture of the film at the size of the recording."""
        cameras = self.session.opened.cameras
        if picture.shape[:2] == (cameras.height, cameras.width):
            return picture
        return cv2.resize(picture, (cameras.width, cameras.height), interpolation=cv2.INTER_AREA).astype(np.uint8)

    def _marked(self, pane: Pane, cameras: Cameras, image: UInt8[NDArray, "_ _ 3"]) -> UInt8[NDArray, "_ _ 3"]:
        """Tint what is selected, in the edited scene's pane."""
        if pane.number != self.session.now.number:
            return image
        chosen = self.session.selected & pane.state.mask[0]
        if not bool(chosen.any()) or bool(chosen.sum() > 0.9 * pane.state.mask.sum()):
            return image
        pixels, depths = project(pane.state.positions[0][chosen].double().cpu(), cameras[0].to(torch.float64))
        scale = image.shape[0] / cameras.height
        radius = float(cameras.intrinsics[0, 1, 1]) * spacing(pane.state) / float(depths.median().clamp(min=1e-3))
        return tinted(image, (pixels[depths > 0] * scale).numpy(), scale * radius)

    # What was clicked

    def pick(self, x: float, y: float, step: int) -> int | None:
        """Return the body at a place of the canvas (shares of width and height), by its cluster; None: no body."""
        rollouts, now = self.rollouts(), self.session.now
        viewpoint = self.viewpoint()
        count = len(rollouts) if len(rollouts) > 1 else (3 if self.mode == FILM and not now.is_edited else 1)
        if self.mode == FILM and now.is_edited and self.true_picture(min(step, now.num_steps)) is not None:
            count += 1
        if self.mode == FILM or len(rollouts) > 1:
            cameras = viewpoint.cameras(self.film_rows[-1])
            found = self._layout(count, cameras.width / cameras.height).find(x, y)
            if found is None:
                return None
            pane, x, y = found
            rollout = now if len(rollouts) == 1 else rollouts[min(pane, len(rollouts) - 1)]  # MuJoCo's is the last
        else:
            cameras, rollout = viewpoint.cameras(self.film_rows[-1]), now
        if rollout is not now:
            return None
        origin, direction = _ray(cameras, x, y)
        state = rollout.states[min(max(step, 0), rollout.num_steps)]
        return body_at(state, now.editor.state.clusters, origin, direction)

    def _canvas(self) -> tuple[int, int]:
        camera = self.client.camera
        height, width = int(camera.image_height), int(camera.image_width)
        return (height, width) if min(height, width) > 0 else _UNKNOWN_SIZE

    def _layout(self, count: int, pane_aspect: float) -> Layout:
        height, width = self._canvas()
        scale = min(1.0, _MAX_ROWS / height)
        high, wide = max(round(scale * height), 64), max(round(scale * width), 64)
        free = round(_FREE_OF_PANEL * high) if width < _NARROW else high
        return replace(lay_out(count, pane_aspect, free, wide), height=high)


def _panes(rollouts: Sequence[Rollout], step: int) -> list[Pane]:
    """Return the panes of a step; a rollout that is not simulated so far shows its last one."""
    panes = []
    for rollout in rollouts:
        reached = min(max(step, 0), rollout.num_steps)
        panes.append(Pane(rollout.number, reached, rollout.states[reached]))
    return panes


def _ray(cameras: Cameras, x: float, y: float) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """Return origin and direction of the ray through a place of a picture (shares of its width and height)."""
    rays = pixel_rays(cameras)
    row, column = min(int(y * cameras.height), cameras.height - 1), min(int(x * cameras.width), cameras.width - 1)
    return rays.origins[0, row, column], rays.directions[0, row, column]
