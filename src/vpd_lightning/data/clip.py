"""One recorded clip as it is read from disk: the frames that a model is shown and those to predict."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.data.collate import driven_tensors
from vpd_lightning.data.driven import read_driven
from vpd_lightning.data.ground_truth import GroundTruth, has_state, read_state
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import ConfigError, DataError
from vpd_lightning.types import NUM_CONTEXT_FRAMES, Cameras, Driven


@dataclass(frozen=True)
class Clip:
    """The frames that a model is shown and those to predict, all cameras; colours are uint8, z-depth is in metres.

    ``cameras`` holds those of the context (axes ``time view``), ``target_cameras`` those of the predicted frames. The
    context ends with frame ``start + 1``; it begins with frame ``start`` for a model that sees two frames, and earlier
    for one that sees more. ``driven`` is the given motion (axis ``time``) from the first frame of the context to the
    last predicted one; None where the recording has none.
    """

    name: str
    trajectory: int
    start: int
    rgb: UInt8[Tensor, "time view height width 3"]
    depth: Float[Tensor, "time view height width"]
    cameras: Cameras
    target_rgb: UInt8[Tensor, "step view height width 3"]
    target_depth: Float[Tensor, "step view height width"]
    target_cameras: Cameras
    workspace_min: tuple[float, float, float]
    workspace_max: tuple[float, float, float]
    frame_time: float
    state: GroundTruth | None
    driven: Driven | None = None

    @property
    def context_driven(self) -> Driven | None:
        """The given motion at the frames of the context."""
        return None if self.driven is None else self.driven[: len(self.rgb)]

    @property
    def target_driven(self) -> Driven | None:
        """The given motion at the frames to predict."""
        return None if self.driven is None else self.driven[len(self.rgb) :]

    @property
    def current_frame(self) -> int:
        """The last input frame; predicted step ``h`` (from 0) is frame ``current_frame + 1 + h``."""
        return self.start + NUM_CONTEXT_FRAMES - 1

    def poses(self, num_steps: int) -> Float[Tensor, "time object 7"]:
        """True poses from the last input frame on, at most ``num_steps`` steps (fewer where the recording ends)."""
        assert self.state is not None
        window = slice(self.current_frame, self.current_frame + num_steps + 1)
        poses = np.concatenate([self.state.positions[window], self.state.quaternions[window]], axis=-1)
        return torch.from_numpy(poses)

    def true_depth(self, step: int) -> tuple[Float[Tensor, "view height width"], Cameras]:
        """Return z-depth in metres and cameras of the last input frame (step 0) or of the ``step``-th one after it.

        Where a sensor was simulated they are those without its errors; of a recording, those measured.
        """
        depth, cameras = self.depth[-1], self.cameras[-1]
        if step:
            depth, cameras = self.target_depth[step - 1], self.target_cameras[step - 1]
        if self.state is None or self.state.depth is None or self.state.cam_to_world is None:
            return depth, cameras
        poses = torch.from_numpy(self.state.cam_to_world).to(cameras.cam_to_world)
        return torch.from_numpy(self.state.depth[self.current_frame + step]), replace(cameras, cam_to_world=poses)

    def previous_pose(self) -> Float[Tensor, "object 7"]:
        """True poses at the frame before the last input frame."""
        assert self.state is not None
        frame = self.current_frame - 1
        return torch.from_numpy(np.concatenate([self.state.positions[frame], self.state.quaternions[frame]], axis=-1))


def read_cameras(reader: TrajectoryReader, times: Sequence[int], views: Sequence[int]) -> Cameras:
    """Return the cameras of some frames and views (axes ``time view``) in float32."""
    intrinsics, cam_to_world = reader.cameras(times, views)
    return Cameras(_float32(intrinsics), _float32(cam_to_world), reader.height, reader.width)


def read_clip(
    path: Path,
    trajectory: int,
    start: int,
    num_steps: int,
    with_state: bool = True,
    num_context: int = NUM_CONTEXT_FRAMES,
) -> Clip:
    """Read one clip of a trajectory, with the last ``num_context`` frames up to frame ``start + 1`` as its context.

    Raises:
        DataError: the recording is too short for it.
        ConfigError: there are fewer frames before the predicted ones than the context needs.
    """
    first = start + NUM_CONTEXT_FRAMES - num_context
    if first < 0:
        raise ConfigError(
            f"The model looks at {num_context} frames, but start frame {start} has only {start + NUM_CONTEXT_FRAMES} "
            f"up to its last input frame.\nStart later: protocol.start_frames=[{num_context - NUM_CONTEXT_FRAMES}]"
        )
    with TrajectoryReader(path) as reader:
        last = start + NUM_CONTEXT_FRAMES + num_steps - 1
        if last >= reader.num_frames:
            raise DataError(
                f"{path} has {reader.num_frames} frames; start frame {start} with {num_steps} steps needs "
                f"{last + 1}.\nLower num_steps to {max(reader.num_frames - start - NUM_CONTEXT_FRAMES, 0)} or fewer, "
                "or start earlier."
            )
        views = range(reader.num_views)
        driven = read_driven(path)
        context, targets = range(first, start + NUM_CONTEXT_FRAMES), range(start + NUM_CONTEXT_FRAMES, last + 1)
        return Clip(
            name=f"{path.parent.name}/{path.name}@{start}",
            trajectory=trajectory,
            start=start,
            rgb=torch.from_numpy(reader.rgb(context, views)),
            depth=torch.from_numpy(reader.depth(context, views)),
            cameras=read_cameras(reader, context, views),
            target_rgb=torch.from_numpy(reader.rgb(targets, views)),
            target_depth=torch.from_numpy(reader.depth(targets, views)),
            target_cameras=read_cameras(reader, targets, views),
            workspace_min=reader.workspace_min,
            workspace_max=reader.workspace_max,
            frame_time=reader.frame_time,
            state=read_state(path) if with_state and has_state(path) else None,
            driven=None if driven is None else driven_tensors(driven.at(range(first, last + 1))),
        )


def read_motion(path: Path, first: int, num_steps: int) -> Driven | None:
    """Return the given motion of a recording from frame ``first`` on (axis ``step``); None where it has none.

    What is driven stays where it is after the last recorded frame.
    """
    driven = read_driven(path)
    if driven is None:
        return None
    last = len(driven.points) - 1
    return driven_tensors(driven.at([min(first + step, last) for step in range(num_steps)]))


def _float32(array: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(array.astype(np.float32))
