"""Clips of single camera views, every start frame once in an epoch: what slot models are trained on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.utils.data import Dataset

from vpd_lightning.data.dataset import require_clips
from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.data.rollout_lengths import RolloutLengths, Schedule
from vpd_lightning.data.views.slot_store import SlotStore
from vpd_lightning.geometry.resizing import resize_images
from vpd_lightning.randomness import RandomKeys, numpy_generator
from vpd_lightning.types import ViewBatch


@dataclass(frozen=True)
class ViewSample:
    """One member of a batch, as a loader worker makes it."""

    images: UInt8[Tensor, "time height width 3"]
    slots: Float[Tensor, "time slot dim"] | None
    seed: int
    step: int
    sample_index: int
    clip: str


@dataclass(frozen=True)
class ViewPlace:
    """Where a clip lies: which trajectory, which of its cameras, its first frame."""

    trajectory: int
    view: int
    start: int


class ViewClipDataset(Dataset[ViewSample]):
    """Item ``i`` is sample ``i % batch_size`` of the global batch of training step ``i // batch_size``.

    A clip is ``num_history + num_steps`` frames of one camera, ``frame_offset`` apart: each camera of ``views`` is a
    video of its own. Where ``num_steps_schedule`` lengthens clips in the course of the training, every clip has room
    for the longest. With ``cache`` the resized frames stay in memory. ``slots`` are stored codes of the same frames.

    An epoch is ``steps_per_epoch`` steps, in which no clip comes twice; every epoch has its own order, drawn from
    (seed, epoch), and leaves out the clips that do not fill a batch. Fewer clips than a batch repeat within it.
    """

    def __init__(
        self,
        *,
        trajectories: Sequence[TrajectoryFrames],
        seed: int,
        batch_size: int,
        max_steps: int,
        num_history: int,
        num_steps: int,
        num_steps_schedule: Schedule | None,
        frame_offset: int,
        views: Sequence[int],
        start_frames: Sequence[int] | None,
        resolution: int,
        cache: bool,
        slots: SlotStore | None,
        training_progress: Callable[[], float] | None = None,
    ) -> None:
        """Check that every trajectory has the frames, views and image size that the clips need.

        Raises DataError where one has not, ValueError for numbers out of range.
        """
        for name, value in {
            "batch_size": batch_size, "max_steps": max_steps, "num_history": num_history, "frame_offset": frame_offset,
            "resolution": resolution,
        }.items():  # fmt: skip
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        if num_steps < 0:
            raise ValueError(f"num_steps must not be negative, got {num_steps}")
        self.trajectories = list(trajectories)
        self.seed, self.batch_size, self.max_steps = seed, batch_size, max_steps
        self.num_history, self.rollout_lengths = num_history, RolloutLengths(num_steps, num_steps_schedule)
        self.frame_offset, self.resolution = frame_offset, resolution
        self.views, self.cache, self.slots = list(views), cache, slots
        self.training_progress = training_progress  # of the training, where a clock ends it and not a number of steps
        # Frames of the recording from the first to the last of the longest clip.
        span = (num_history + self.rollout_lengths.longest - 1) * frame_offset + 1
        require_clips(self.trajectories, 0, self.views, start_frames, num_context_frames=span)
        self._starts = [
            list(range(item.num_frames - span + 1)) if start_frames is None else list(start_frames)
            for item in self.trajectories
        ]
        # Clips are numbered trajectory by trajectory; this is the first number behind each.
        self._ends = np.cumsum([len(self.views) * len(starts) for starts in self._starts])
        self._order: tuple[int, Int[np.ndarray, " clip"]] | None = None
        self._frames: dict[tuple[int, int], Tensor] = {}

    @property
    def num_clips(self) -> int:
        """How many different clips there are."""
        return int(self._ends[-1])

    @property
    def steps_per_epoch(self) -> int:
        """Steps in which every clip comes once, but for those left over."""
        return max(1, self.num_clips // self.batch_size)

    def __len__(self) -> int:
        return self.max_steps * self.batch_size

    def __getitem__(self, item: int) -> ViewSample:
        step, sample_index = divmod(item, self.batch_size)
        place = self.place(step, sample_index)
        trajectory = self.trajectories[place.trajectory]
        done = step / self.max_steps if self.training_progress is None else self.training_progress()
        count = self.num_history + self.rollout_lengths.at(done, self.seed, step)
        times = range(place.start, place.start + count * self.frame_offset, self.frame_offset)
        return ViewSample(
            images=self._images(place.trajectory, place.view, times),
            slots=None if self.slots is None else self.slots.read(trajectory.path, place.view, times),
            seed=self.seed,
            step=step,
            sample_index=sample_index,
            clip=f"{trajectory.path.parent.name}/{trajectory.path.name}#{place.view}@{place.start}",
        )

    def place(self, step: int, sample_index: int) -> ViewPlace:
        """Return which clip a sample is; depends on (seed, step, sample index) alone."""
        epoch, step_in_epoch = divmod(step, self.steps_per_epoch)
        if self._order is None or self._order[0] != epoch:
            draw = numpy_generator(self.seed, epoch, "view clips")
            self._order = (epoch, draw.permutation(self.num_clips))
        clip = int(self._order[1][(step_in_epoch * self.batch_size + sample_index) % self.num_clips])
        trajectory = int(np.searchsorted(self._ends, clip, side="right"))
        starts = self._starts[trajectory]
        first = int(self._ends[trajectory]) - len(self.views) * len(starts)
        view, start = divmod(clip - first, len(starts))
        return ViewPlace(trajectory, self.views[view], starts[start])

    def _images(self, index: int, view: int, times: Sequence[int]) -> UInt8[Tensor, "time height width 3"]:
        if not self.cache:
            return resized_frames(self.trajectories[index], view, times, self.resolution)
        if (index, view) not in self._frames:
            every = range(self.trajectories[index].num_frames)
            self._frames[index, view] = resized_frames(self.trajectories[index], view, every, self.resolution)
        return self._frames[index, view][list(times)]


def resized_frames(
    trajectory: TrajectoryFrames, view: int, times: Sequence[int], resolution: int
) -> UInt8[Tensor, "time resolution resolution 3"]:
    """Return frames of one camera at the resolution of the system."""
    return resize_images(torch.from_numpy(trajectory.rgb(times, [view])[:, 0]), resolution)


def collate_views(samples: Sequence[ViewSample], num_history: int) -> ViewBatch:
    """Stack samples of one training step to a batch."""
    steps = {sample.step for sample in samples}
    if len(steps) != 1:
        raise ValueError(f"a batch holds samples of one training step, got steps {sorted(steps)}")
    slots = [sample.slots for sample in samples if sample.slots is not None]
    return ViewBatch(
        images=torch.stack([sample.images for sample in samples]),
        slots=torch.stack(slots) if slots else None,
        num_history=num_history,
        keys=RandomKeys(samples[0].seed, samples[0].step, [sample.sample_index for sample in samples]),
        clips=[sample.clip for sample in samples],
    )
