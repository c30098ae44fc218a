"""Per-camera median images of the training split: what fixed cameras see when nothing stands in the way."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, UInt8

from vpd_lightning.data.frames import TrajectoryFrames
from vpd_lightning.errors import DataError

# Odd, so that the median is a value that was measured. More frames change the median image little and cost time.
MAX_FRAMES = 63
_GOLDEN_RATIO = 0.6180339887498949


def median_images(
    trajectories: Sequence[TrajectoryFrames], views: Sequence[int]
) -> tuple[UInt8[np.ndarray, "view height width 3"], Float32[np.ndarray, "view height width"]]:
    """Return the per-pixel median colour and median z-depth (metres, 0 where never measured) of each view.

    Taken over a fixed subset of frames, spread evenly over trajectories and time. Raises DataError where the cameras of
    the trajectories differ or move, because the median of different pictures means nothing.
    """
    require_fixed_cameras(trajectories)
    chosen = _spread(trajectories)
    rgbs, depths = [], []
    for view in views:
        rgb = np.concatenate([trajectories[index].rgb([time], [view])[:, 0] for index, time in chosen])
        depth = np.concatenate([trajectories[index].depth([time], [view])[:, 0] for index, time in chosen])
        middle = len(chosen) // 2
        rgbs.append(np.partition(rgb, middle, axis=0)[middle])
        depths.append(_valid_median(depth))
    return np.stack(rgbs), np.stack(depths)


def require_fixed_cameras(trajectories: Sequence[TrajectoryFrames]) -> None:
    """Raise DataError unless all cameras stand still and are the same in all trajectories."""
    first = trajectories[0]
    reference = first.cameras([0], range(first.num_views))
    for item in trajectories:
        same = item.num_views == first.num_views and item.is_static
        if same:
            here = item.cameras([0], range(item.num_views))
            same = all(np.allclose(a, b, rtol=0.0, atol=1e-6) for a, b in zip(here, reference, strict=True))
        if not same:
            raise DataError(
                f"{item.path}: its cameras move, or differ from those of {first.path.name}.\n"
                "A background by median images needs cameras that are fixed over the whole training split.\n"
                "Use encoder.background=null and data.moving_ray_fraction=0 for this data set."
            )


def _spread(trajectories: Sequence[TrajectoryFrames]) -> list[tuple[int, int]]:
    """Return (trajectory, time) pairs: all frames of a small split, else an even spread over both."""
    every = [(index, time) for index, item in enumerate(trajectories) for time in range(item.num_frames)]
    if len(every) <= MAX_FRAMES:
        return every
    pairs = []
    for step in range(MAX_FRAMES):
        index = step * len(trajectories) // MAX_FRAMES
        pairs.append((index, int((step * _GOLDEN_RATIO) % 1.0 * trajectories[index].num_frames)))
    return pairs


def _valid_median(depth: Float32[np.ndarray, "frame height width"]) -> Float32[np.ndarray, "height width"]:
    """Median of the measured depths of each pixel (the upper one of an even count); 0 where there is none."""
    valid = np.isfinite(depth) & (depth > 0)
    ordered = np.sort(np.where(valid, depth, np.inf), axis=0)
    count = valid.sum(axis=0)
    middle = np.take_along_axis(ordered, (count // 2)[None].clip(max=len(depth) - 1), axis=0)[0]
    return np.where(count > 0, middle, 0.0).astype(np.float32)
