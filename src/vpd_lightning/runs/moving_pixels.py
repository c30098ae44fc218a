"""What ``model=inertial`` takes for what may move in a recording, before anything is trained."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from vpd_lightning.config import build_simulator, compose
from vpd_lightning.data.clip import read_cameras
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.encoder.particles.unprojection import UnprojectingEncoder
from vpd_lightning.geometry.noisy_planes import relative_noise
from vpd_lightning.types import RGBDFrames

MOST_NOISE = 0.009
"""Share of depth up to which what may move was measured to be found (docs/notes.md, What may move in noisy depth)."""

_NUM_FRAMES = 3


@dataclass(frozen=True)
class MovingPixels:
    """Pixels of some frames (``times``) of all views; ``noise`` is the standard deviation of depth as a share of it."""

    times: list[int]
    moving: Bool[np.ndarray, "time view height width"]
    in_workspace: Bool[np.ndarray, "time view height width"]
    noise: Float[np.ndarray, " view"]
    view_names: tuple[str, ...] = ()

    def summary(self) -> list[str]:
        """Return lines for a person, with a warning where depth is too noisy."""
        share = self.moving.sum() / max(int(self.in_workspace.sum()), 1)
        names = [f"{name} " for name in self.view_names] or [""] * len(self.noise)
        each = ", ".join(f"{name}{100 * value:.2f}" for name, value in zip(names, self.noise, strict=True))
        views = f" (by view {each})" if len(self.noise) > 1 else ""
        lines = [
            f"depth noise    {100 * np.median(self.noise):.2f} % of depth{views}",
            f"may move       {share:.1%} of the pixels in the workspace, for model=inertial",
        ]
        if np.median(self.noise) > MOST_NOISE:
            lines.append(
                f"warning: above {100 * MOST_NOISE:.1f} % of noise what may move is not found reliably. Import with "
                "smooth=2 flying_pixels=0.02 and\n         a smaller height=, or record from nearer by."
            )
        return lines


def find_moving_pixels(path: Path) -> MovingPixels:
    """Look at the first, middle and last frame of a trajectory file.

    Raises:
        DataError: the file is broken.
    """
    with TrajectoryReader(path) as reader:
        times = sorted({round(place) for place in np.linspace(0, reader.num_frames - 1, _NUM_FRAMES)})
        views = range(reader.num_views)
        depth = reader.depth(times, views)
        frames = RGBDFrames(
            torch.from_numpy(reader.rgb(times, views)), torch.from_numpy(depth), read_cameras(reader, times, views)
        )
        names = reader.view_names
        corners = {name: list(getattr(reader, name)) for name in ("workspace_min", "workspace_max")}
    words = [f"scene.{name}={corner}" for name, corner in corners.items()]
    config = compose("train", ["experiment=recordings", "size=small", "data.folder=unused", *words])
    encoder = build_simulator(config).encoder
    assert isinstance(encoder, UnprojectingEncoder)
    moving, in_workspace = encoder.moving_pixels(frames)
    noise = np.median([relative_noise(one.astype(np.float64), one > 0) for one in depth], axis=0)
    return MovingPixels(times, moving.numpy(), in_workspace.numpy(), noise, names)
