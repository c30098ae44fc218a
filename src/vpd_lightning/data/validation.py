"""Fixed clips of a held-out split, with whole frames to compare with."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch.utils.data import Dataset

from vpd_lightning.data.collate import driven_tensors
from vpd_lightning.data.dataset import require_clips
from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.types import Cameras, RGBDFrames

_LONGEST_HISTORY = 6  # frames; of SlotFormer, the system that is shown most


@dataclass(frozen=True)
class VideoClip:
    """Context frames (two, or as many as the system needs) and the frames after them (axes ``time view``).

    ``number`` is its place among all validation clips, whichever process predicts it.
    """

    context: RGBDFrames
    target: RGBDFrames
    name: str
    number: int

    def to(self, *args: Any, **kwargs: Any) -> "VideoClip":
        """Move both parts to a device or floating dtype."""
        return replace(self, context=self.context.to(*args, **kwargs), target=self.target.to(*args, **kwargs))


class ValidationClips(Dataset[VideoClip]):
    """Clip ``i`` is the i-th of an even spread over the trajectories and over the start frames that leave room.

    Where no ``start_frames`` are given, systems that are shown more frames than others predict the same ones: the first
    predicted frame is frame 6 or later, unless the recordings are too short for as many different clips.
    """

    def __init__(
        self,
        *,
        trajectories: Sequence[TrajectoryFrames],
        num_clips: int,
        num_context_frames: int,
        num_steps: int,
        input_views: Sequence[int],
        target_views: Sequence[int],
        start_frames: Sequence[int] | None,
        load_driven: bool = False,
    ) -> None:
        require_clips(trajectories, num_steps, [*input_views, *target_views], start_frames, num_context_frames)
        self.num_context_frames, self.num_steps = num_context_frames, num_steps
        self.input_views, self.target_views = list(input_views), list(target_views)
        self.load_driven = load_driven
        self.clips: list[tuple[TrajectoryFrames, int]] = []
        for index in range(num_clips):
            lap, place = divmod(index, len(trajectories))
            laps = -(-num_clips // len(trajectories))
            trajectory = trajectories[place]
            if start_frames is not None:
                starts = list(start_frames)
            else:
                latest = trajectory.num_frames - num_steps
                is_long = latest - _LONGEST_HISTORY + 1 >= laps  # the same answer for all systems
                earliest = max(num_context_frames, _LONGEST_HISTORY if is_long else 0)
                starts = [first - num_context_frames for first in range(earliest, latest + 1)]
            self.clips.append((trajectory, starts[lap * len(starts) // laps]))

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, index: int) -> VideoClip:
        trajectory, start = self.clips[index]
        first_target = start + self.num_context_frames
        return VideoClip(
            context=self._frames(trajectory, range(start, first_target), self.input_views),
            target=self._frames(trajectory, range(first_target, first_target + self.num_steps), self.target_views),
            name=f"{trajectory.path.parent.name}/{trajectory.path.name}@{start}",
            number=index,
        )

    def _frames(self, trajectory: TrajectoryFrames, times: Sequence[int], views: Sequence[int]) -> RGBDFrames:
        intrinsics, cam_to_world = (torch.from_numpy(part).float() for part in trajectory.cameras(times, views))
        return RGBDFrames(
            rgb=torch.from_numpy(trajectory.rgb(times, views)),
            depth=torch.from_numpy(trajectory.depth(times, views)),
            cameras=Cameras(intrinsics, cam_to_world, trajectory.height, trajectory.width),
            driven=driven_tensors(trajectory.driven(times)) if self.load_driven else None,
        )
