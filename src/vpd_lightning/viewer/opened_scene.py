"""What the viewer shows: a trained simulator, two frames of a recording, and what really happened then."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.data.clip import read_clip
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.editing.colored_editor import colored_editor
from vpd_lightning.evaluation.prediction import encode_clip, recorded_motion
from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.media.camera_paths import common_target
from vpd_lightning.media.particle_colors import particle_colors
from vpd_lightning.simulator import Scene, Simulator
from vpd_lightning.types import Cameras, Particles
from vpd_lightning.viewer.frame_cache import FrameCache
from vpd_lightning.viewer.rollout import Rollout


@dataclass(frozen=True)
class OpenedScene:
    """A model and a recording, shared by all clients and never changed; what was drawn of it is kept.

    ``truth`` are the recorded images from the last input frame on (time 0), as long as the recording goes.
    """

    simulator: Simulator
    scene: Scene
    cameras: Cameras  # of all views, at the last input frame
    truth: UInt8[NDArray, "time view height width 3"]
    input_views: Sequence[int]
    workspace_min: tuple[float, float, float]
    workspace_max: tuple[float, float, float]
    path: Path
    start: int
    title: str
    kind: str  # of the data set: the name of the generated scene, "imported", ...
    rollout: Rollout  # of the scene as recorded; grows while it is simulated
    manifest: Manifest | None = None  # of the data set, where it is known
    frames: FrameCache = field(default_factory=FrameCache)

    @cached_property
    def viewpoint(self) -> Float[Tensor, " 3"]:
        """The middle of the input cameras (metres): particles are coloured as seen from there."""
        return self.cameras.cam_to_world[list(self.input_views), :3, 3].mean(dim=0)

    @cached_property
    def target(self) -> NDArray[np.float64]:
        """The point that the cameras look at (metres)."""
        middle = torch.tensor([self.workspace_min, self.workspace_max]).mean(dim=0)
        return common_target(self.cameras, middle).double().numpy()

    @property
    def num_true_steps(self) -> int:
        """How many steps behind the last input frame were recorded."""
        return len(self.truth) - 1

    @property
    def observed_colors(self) -> UInt8[NDArray, "particle 3"]:
        """Colours that the encoder saw at the last input frame, without asking the renderer; grey if it saw none."""
        current = self.scene.current
        if current.colors is None:
            return np.full((current.num_particles, 3), 128, np.uint8)
        return (current.colors[0].float().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()

    @cached_property
    def first_colors(self) -> UInt8[NDArray, "particle 3"]:
        """Colours of the last input frame's particles: every client begins with them."""
        return self.colors(self.scene.current)

    def colors(self, state: Particles) -> UInt8[NDArray, "particle 3"]:
        """Return the renderer's colour of each slot's particle; black for padding."""
        colors = np.zeros((state.num_particles, 3), np.uint8)
        there = state.mask[0].cpu().numpy()
        if there.any():
            colors[there] = particle_colors(self.simulator.renderer, state, self.viewpoint)
        return colors

    def seen_points(self, step: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Return what the input cameras measured at a step: points (metres) in the workspace, and colours."""
        with TrajectoryReader(self.path) as reader:
            time = self.start + 1 + step
            rgb = reader.rgb([time], self.input_views)[0]
            depth = torch.from_numpy(reader.depth([time], self.input_views)[0])
            intrinsics, poses = reader.cameras([time], self.input_views)
        cameras = Cameras(torch.from_numpy(intrinsics[0]), torch.from_numpy(poses[0]), *rgb.shape[1:3])
        points = unproject(depth.double(), cameras).numpy()
        inside = (depth.numpy() > 0) & np.isfinite(depth.numpy())
        inside &= ((points >= self.workspace_min) & (points <= self.workspace_max)).all(axis=-1)
        return points[inside].astype(np.float32), rgb[inside]


def open_scene(
    simulator: Simulator,
    path: Path,
    start: int,
    input_views: Sequence[int],
    title: str,
    kind: str = "",
    manifest: Manifest | None = None,
) -> OpenedScene:
    """Read a recording and encode the frames ``start`` and ``start + 1``; ``kind`` is the scene of its data set.

    With the ``manifest`` of the data set, edits can be held against the generator's own simulation.

    Raises:
        DataError: the recording lacks them.
    """
    clip = read_clip(path, 0, start, num_steps=0, with_state=False)
    with TrajectoryReader(path) as reader:
        truth = reader.rgb(range(start + 1, reader.num_frames), range(reader.num_views))
        intrinsics, poses = reader.cameras([start + 1], range(reader.num_views))
        height, width = reader.height, reader.width
        low, high = reader.workspace_min, reader.workspace_max
    cameras = Cameras(torch.from_numpy(intrinsics[0]).float(), torch.from_numpy(poses[0]).float(), height, width)
    scene = encode_clip(simulator, clip, list(input_views))
    viewpoint = cameras.cam_to_world[list(input_views), :3, 3].mean(dim=0)
    motion = recorded_motion(simulator, path, start, len(truth) - 1)
    return OpenedScene(
        simulator, scene, cameras, truth, tuple(input_views), low, high, path, start, title, kind,
        Rollout(simulator, colored_editor(simulator, scene, viewpoint), motion), manifest,
    )  # fmt: skip
