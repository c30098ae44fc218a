"""What is solid around a body: known from the ground truth, which the model never sees."""

from collections.abc import Sequence

import torch

from vpd_lightning.data.clip import Clip
from vpd_lightning.evaluation.bodies import Body
from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.geometry.workspace import inside_workspace
from vpd_lightning.metrics.body_track import Obstacle

_MIN_FLOOR_POINTS = 50
_FLOOR_QUANTILE = 0.05


def floor_height(clip: Clip) -> float:
    """Height in metres of the lowest static surface in the workspace; NaN where none is seen.

    The 5 % quantile of the heights of all measured pixels that show no body, at the last input frame: all of them are
    equal above a level floor, and a few bad depths below it do not count.
    """
    assert clip.state is not None
    depth, cameras = clip.true_depth(0)
    static = torch.from_numpy(clip.state.segmentation[clip.current_frame]) == 0
    points = unproject(depth, cameras)[static & torch.isfinite(depth) & (depth > 0)]
    points = points[inside_workspace(points, clip.workspace_min, clip.workspace_max)]
    if points.shape[0] < _MIN_FLOOR_POINTS:
        return float("nan")
    return float(torch.quantile(points[:, 2].double()[:: points.shape[0] // 100_000 + 1], _FLOOR_QUANTILE))


def obstacles(clip: Clip, bodies: Sequence[Body], number: int, num_steps: int) -> list[Obstacle]:
    """Return the boxes of the other rigid bodies, for the particles of body ``number``."""
    assert clip.state is not None
    poses, own = clip.poses(num_steps)[1:], bodies[number].mask
    return [
        # What starts in the box of another body may be that body's own.
        Obstacle(torch.from_numpy(clip.state.half_sizes[other]), poses[:, other], body.mask[own])
        for other, body in enumerate(bodies)
        if other != number and not body.is_soft
    ]
