"""Training clips: two context frames and rays of the frames after them, drawn from (seed, step, sample index) alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float32, Int, UInt8
from scipy.ndimage import maximum_filter
from torch.utils.data import Dataset

from vpd_lightning.data.collate import ClipSample, driven_tensors
from vpd_lightning.data.frame_source import FrameSource
from vpd_lightning.data.rollout_lengths import RolloutLengths, Schedule
from vpd_lightning.errors import DataError
from vpd_lightning.geometry.cameras import rays_through
from vpd_lightning.randomness import numpy_generator
from vpd_lightning.types import NUM_CONTEXT_FRAMES, Cameras


class MovingPixels(Protocol):
    """Where a ``fraction`` of a frame's rays is drawn from."""

    @property
    def fraction(self) -> float: ...

    def pixels(self, trajectory: FrameSource, time: int, views: Sequence[int]) -> Int[np.ndarray, " pixel"]:
        """Return flat indices (view, y, x) of the moving pixels of a frame in these views."""
        ...


@dataclass(frozen=True)
class MovingRays:
    """Draw a share of the rays from pixels that differ from the per-camera median of the training split.

    # Paper: rays are uniform over all pixels (fraction 0). A small moving body covers few of them.
    """

    fraction: float
    margin: int
    color_threshold: float
    depth_threshold: float
    rgb: UInt8[np.ndarray, "view height width 3"]
    depth: Float32[np.ndarray, "view height width"]

    def __post_init__(self) -> None:
        if not 0.0 <= self.fraction <= 1.0:
            raise ValueError(f"moving_ray_fraction must lie in [0, 1], got {self.fraction}")
        if self.margin < 0:
            raise ValueError(f"moving_ray_margin must be a number of pixels from 0 up, got {self.margin}")

    def pixels(self, trajectory: FrameSource, time: int, views: Sequence[int]) -> Int[np.ndarray, " pixel"]:
        """Return what ``find`` finds in a frame."""
        return self.find(trajectory.rgb([time], views)[0], trajectory.depth([time], views)[0])

    def find(
        self, rgb: UInt8[np.ndarray, "view height width 3"], depth: Float32[np.ndarray, "view height width"]
    ) -> Int[np.ndarray, " pixel"]:
        """Return flat indices (view, y, x) of pixels whose colour or depth differs by more than the thresholds.

        Pixels up to ``margin`` beside them count, too: where rays are drawn much more densely on one side of an outline
        than on the other, a renderer learns to draw bodies too large.

        Colours differ by their largest channel, in [0, 1]; depths in metres, where both are measured.
        """
        high, low = np.maximum(rgb, self.rgb), np.minimum(rgb, self.rgb)
        moved = (high - low).max(axis=-1) > self.color_threshold * 255.0
        measured = np.isfinite(depth) & (depth > 0) & (self.depth > 0)
        moved |= measured & (np.abs(np.where(measured, depth, 0.0) - self.depth) > self.depth_threshold)
        if self.margin:
            width = 2 * self.margin + 1
            moved = maximum_filter(moved, size=(1, width, width))
        return np.flatnonzero(moved).astype(np.int32)


class ClipDataset(Dataset[ClipSample]):
    """Item ``i`` is sample ``i % batch_size`` of the global batch of training step ``i // batch_size``.

    A sample is a clip of T + 2 frames of a trajectory: frames ``start`` and ``start + 1`` of the input views as
    context, and rays of frames ``start + 2 ... start + 1 + T`` of the target views with the colours seen along them.
    With ``load_future`` the input views' images of those frames come too, with ``load_driven`` the given motion of all.

    ``training_progress`` returns the share of the training that is done, where a time budget ends it instead of
    ``max_steps``.
    """

    def __init__(
        self,
        *,
        trajectories: Sequence[FrameSource],
        seed: int,
        batch_size: int,
        max_steps: int,
        num_steps: int,
        num_steps_schedule: Schedule | None,
        rays_per_step: int,
        input_views: Sequence[int],
        target_views: Sequence[int],
        start_frames: Sequence[int] | None,
        moving_rays: MovingPixels | None,
        load_future: bool,
        load_driven: bool = False,
        training_progress: Callable[[], float] | None = None,
    ) -> None:
        """Check that every trajectory has the frames, views and image size that the clips need.

        Raises DataError where one has not, ValueError for numbers out of range.
        """
        for name, value in {
            "batch_size": batch_size, "max_steps": max_steps, "num_steps": num_steps, "rays_per_step": rays_per_step
        }.items():  # fmt: skip
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self.trajectories = list(trajectories)
        self.seed, self.batch_size, self.max_steps = seed, batch_size, max_steps
        self.rays_per_step = rays_per_step
        self.rollout_lengths = RolloutLengths(num_steps, num_steps_schedule)
        self.input_views, self.target_views = list(input_views), list(target_views)
        self.start_frames = None if start_frames is None else list(start_frames)
        self.moving_rays, self.load_future, self.load_driven = moving_rays, load_future, load_driven
        self.training_progress = training_progress
        self._moving_pixels: dict[tuple[int, int], np.ndarray] = {}
        longest = self.rollout_lengths.longest
        require_clips(self.trajectories, longest, [*self.input_views, *self.target_views], self.start_frames)

    def __len__(self) -> int:
        return self.max_steps * self.batch_size

    def _share_done(self, step: int) -> float:
        return step / self.max_steps if self.training_progress is None else self.training_progress()

    def __getitem__(self, item: int) -> ClipSample:
        step, sample_index = divmod(item, self.batch_size)
        num_steps = self.rollout_lengths.at(self._share_done(step), self.seed, step)
        draw = numpy_generator(self.seed, step, sample_index, "clip")
        index = int(draw.integers(len(self.trajectories)))
        trajectory = self.trajectories[index]
        if self.start_frames is None:
            start = int(draw.integers(trajectory.num_frames - NUM_CONTEXT_FRAMES - num_steps + 1))
        else:
            start = self.start_frames[int(draw.integers(len(self.start_frames)))]
        targets = range(start + NUM_CONTEXT_FRAMES, start + NUM_CONTEXT_FRAMES + num_steps)
        frames = range(start, targets.stop if self.load_future else targets.start)
        intrinsics, cam_to_world = trajectory.cameras(frames, self.input_views)

        rays = numpy_generator(self.seed, step, sample_index, "rays")
        drawn = [self._target_rays(index, time, rays) for time in targets]
        origins, directions, rgbs = (torch.stack(parts) for parts in zip(*drawn, strict=True))
        return ClipSample(
            rgb=torch.from_numpy(trajectory.rgb(frames, self.input_views)),
            depth=torch.from_numpy(trajectory.depth(frames, self.input_views)),
            intrinsics=torch.from_numpy(intrinsics).float(),
            cam_to_world=torch.from_numpy(cam_to_world).float(),
            origins=origins,
            directions=directions,
            rgbs=rgbs,
            seed=self.seed,
            step=step,
            sample_index=sample_index,
            clip=f"{trajectory.path.parent.name}/{trajectory.path.name}@{start}",
            driven=driven_tensors(trajectory.driven(range(start, targets.stop))) if self.load_driven else None,
        )

    def _target_rays(
        self, index: int, time: int, rays: np.random.Generator
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return origins, unit directions and colours of the rays of one target frame."""
        trajectory = self.trajectories[index]
        height, width = trajectory.height, trajectory.width
        pixel = rays.integers(len(self.target_views) * height * width, size=self.rays_per_step)
        if self.moving_rays is not None and self.moving_rays.fraction > 0:
            moving = self._moving(index, time)
            count = round(self.moving_rays.fraction * self.rays_per_step)
            chosen = rays.random(count)  # drawn in any case: the stream must not depend on the pictures
            if len(moving):
                pixel[:count] = moving[(chosen * len(moving)).astype(np.int64)]
        view, y, x = np.unravel_index(pixel, (len(self.target_views), height, width))

        seen = np.unique(view)  # images of views without a ray are not read
        images = trajectory.rgb([time], [self.target_views[v] for v in seen])[0]
        rgbs = torch.from_numpy(images[np.searchsorted(seen, view), y, x].astype(np.float32) / 255.0)

        intrinsics, cam_to_world = (torch.from_numpy(a[0][view]) for a in trajectory.cameras([time], self.target_views))
        centers = torch.from_numpy(np.stack([x, y], axis=-1) + 0.5)[:, None]  # pixel centres at +0.5
        lines = rays_through(Cameras(intrinsics, cam_to_world, height, width), centers)
        return lines.origins[:, 0].float(), lines.directions[:, 0].float(), rgbs

    def _moving(self, index: int, time: int) -> Int[np.ndarray, " pixel"]:
        """Return the moving pixels of one frame; remembered where the frames are kept in memory, too."""
        assert self.moving_rays is not None
        if (index, time) in self._moving_pixels:
            return self._moving_pixels[index, time]
        trajectory = self.trajectories[index]
        found = self.moving_rays.pixels(trajectory, time, self.target_views)
        if trajectory.use_cache:
            self._moving_pixels[index, time] = found
        return found


def require_clips(
    trajectories: Sequence[FrameSource],
    num_steps: int,
    views: Sequence[int],
    start_frames: Sequence[int] | None,
    num_context_frames: int = NUM_CONTEXT_FRAMES,
) -> None:
    """Raise DataError unless every trajectory holds the frames, the views and the image size of the first one."""
    if not trajectories:
        raise DataError(
            "There is no trajectory in this split.\nGenerate the data set again, or point data.folder elsewhere."
        )
    first = trajectories[0]
    needed = num_context_frames + num_steps + max(start_frames or [0])
    for item in trajectories:
        if item.num_frames < needed:
            raise DataError(
                f"{item.path}: {item.num_frames} frames, but a clip needs {needed}"
                f" ({num_context_frames} context frames + {num_steps} steps from frame {max(start_frames or [0])}).\n"
                "Lower data.num_steps or data.start_frames, or use longer trajectories."
            )
        wrong = sorted({view for view in views if not 0 <= view < item.num_views})
        if wrong:
            raise DataError(
                f"{item.path}: has {item.num_views} views (0 to {item.num_views - 1}),"
                f" but view {wrong[0]} is asked for.\n"
                "Correct scene.input_views or data.target_views."
            )
        if (item.height, item.width) != (first.height, first.width):
            raise DataError(
                f"{item.path}: images are {item.height}x{item.width}, but those of {first.path.name} are"
                f" {first.height}x{first.width}.\nAll trajectories of a data set need one image size."
            )
