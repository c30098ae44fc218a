"""The paper's novel-view figure: one predicted moment from a ring of cameras, rendered and as particles.

``python -m docs.results.studies.novel_view_figure MODEL --data FOLDER`` rolls a test scene out, stops after ``--step``
steps, and writes one picture: the rendered views of ``--views`` cameras on a circle around the scene, and below them
the moving particles in the colours that cameras saw, from the same places. The ring has the mean height and distance of
the recorded cameras, so that some of its places may be near one of these.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray

from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.files import OutputFolder
from vpd_lightning.loading import load_model
from vpd_lightning.media.camera_paths import ring_cameras
from vpd_lightning.media.pictures import write_png
from vpd_lightning.media.video import enlarge, framed, label_bar
from vpd_lightning.types import Cameras, Particles
from vpd_lightning.viewer.opened_scene import OpenedScene, open_scene
from vpd_lightning.viewer.session import to_uint8

_SIZE = 256
_DOT = 3
"""Pixels on a side of a particle."""
_GROUND = 24


def particle_picture(particles: Particles, colors: UInt8[NDArray, "particle 3"], camera: Cameras) -> NDArray[np.uint8]:
    """Draw what moves (batch of 1) as small squares, near ones in front; the camera has no axes."""
    shown = particles.mask[0] if particles.moving is None else particles.mask[0] & particles.moving[0]
    to_camera = torch.linalg.inv(camera.cam_to_world.double())
    places = particles.positions[0][shown].double() @ to_camera[:3, :3].T + to_camera[:3, 3]
    pixels = places @ camera.intrinsics.double().T
    in_front = places[:, 2] > 0
    order = torch.argsort(places[:, 2], descending=True)
    order = order[in_front[order]]
    corners = (pixels[order, :2] / pixels[order, 2:] - _DOT / 2).round().int().tolist()
    image = np.full((camera.height, camera.width, 3), _GROUND, np.uint8)
    for (x, y), color in zip(corners, colors[shown.numpy()][order.numpy()], strict=True):
        image[max(y, 0) : max(y + _DOT, 0), max(x, 0) : max(x + _DOT, 0)] = color
    return image


def figure(opened: OpenedScene, step: int, num_views: int) -> NDArray[np.uint8]:
    """Return the picture: rendered views above, particles below, one column for each place of the ring."""
    ring = ring_cameras(opened.cameras, num_views, torch.from_numpy(opened.target).float())
    state = opened.simulator.rollout(opened.scene, step)[-1]
    rendered = [enlarge(to_uint8(image), _SIZE) for image in opened.simulator.render([state], ring)[0]]
    scale = _SIZE / max(ring.height, ring.width)
    large = Cameras(
        ring.intrinsics * torch.tensor([scale, scale, 1.0])[:, None],
        ring.cam_to_world, round(scale * ring.height), round(scale * ring.width),
    )  # fmt: skip
    colors = opened.observed_colors
    dots = [particle_picture(state, colors, large[view]) for view in range(num_views)]
    rows = [np.concatenate([framed(image) for image in images], axis=1) for images in (rendered, dots)]
    each = rows[0].shape[1] // num_views
    head = [label_bar(f"{360 * view // num_views} degrees", each) for view in range(num_views)]
    return np.concatenate([np.concatenate(head, axis=1), *rows])


def main(arguments: Sequence[str] | None = None) -> None:
    """Write ``figure.png``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="run folder, checkpoint or released model")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--split", default="test")
    parser.add_argument("--trajectory", type=int, default=0)
    parser.add_argument("--start", type=int, default=4)
    parser.add_argument("--step", type=int, default=8)
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--out", type=Path, default=Path("runs/novel_view_figure"))
    options = parser.parse_args(arguments)
    model = load_model(options.model)
    path = load_manifest(options.data).split(options.split)[options.trajectory]
    opened = open_scene(model.simulator, path, options.start, model.input_views, model.name)
    with OutputFolder(options.out) as folder:
        write_png(folder / "figure.png", figure(opened, options.step, options.views))
    print(options.out / "figure.png")


if __name__ == "__main__":
    main()
