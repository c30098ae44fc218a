"""How deep predicted particles lie in what is solid: ground truth says where that is, the model never sees it."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.data.clip import Clip
from vpd_lightning.evaluation.bodies import Body
from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.geometry.workspace import inside_workspace
from vpd_lightning.metrics.penetration import below_floor, deepest, inside_box_depth

PENETRATION_METRICS = ("mean", "floor", "bodies", "true_motion")
_MIN_FLOOR_POINTS = 50
_FLOOR_QUANTILE = 0.05


def floor_height(clip: Clip) -> float:
    """Height in metres of the lowest static surface in the workspace; NaN where none is seen.

    The 5 % quantile of the heights of all measured pixels that show no body, at the last input frame: all of them are
    equal above a level floor, and a few bad depths below it do not count.
    """
    assert clip.state is not None
    depth = clip.depth[-1]
    static = torch.from_numpy(clip.state.segmentation[clip.current_frame]) == 0
    points = unproject(depth, clip.cameras[-1])[static & torch.isfinite(depth) & (depth > 0)]
    points = points[inside_workspace(points, clip.workspace_min, clip.workspace_max)]
    if points.shape[0] < _MIN_FLOOR_POINTS:
        return float("nan")
    return float(torch.quantile(points[:, 2].double()[:: points.shape[0] // 100_000 + 1], _FLOOR_QUANTILE))


def clip_penetration(
    clip: Clip, bodies: Sequence[Body], positions: Float[Tensor, "time particle 3"], min_particles: int
) -> dict[str, Float[Tensor, "object step"]]:
    """Depth in metres of each body's deepest particle: below the ``floor``, in other ``bodies``, and the larger: mean.

    Other bodies count where they are rigid, by their true boxes (the box of a round body is larger than it is).
    ``true_motion`` is what the larger would be if the particles followed the truth: particles are where cameras and
    encoder put them, so it need not be 0. NaN for bodies with fewer than ``min_particles`` particles, predictions that
    are not finite, and where nothing is known: no floor seen, no other rigid body, or the end of the recording.
    """
    height = floor_height(clip)
    rows = []
    for number, body in enumerate(bodies):
        num_steps = positions.shape[0] - 1
        row = {name: torch.full((num_steps,), torch.nan, dtype=torch.float64) for name in PENETRATION_METRICS}
        rows.append(row)
        if body.mask.sum() < min_particles:
            continue
        pred = positions[1:, body.mask]
        # What starts in the box of another body may be that body's own.
        others = [(i, other.mask[body.mask]) for i, other in enumerate(bodies) if i != number and not other.is_soft]
        row["floor"], row["bodies"] = _depths(clip, pred, others, height)
        row["mean"] = torch.fmax(row["floor"], row["bodies"])
        num_true = min(num_steps, body.true.shape[0] - 1)
        row["true_motion"][:num_true] = torch.fmax(*_depths(clip, body.true[1 : num_true + 1], others, height))
        finite = torch.isfinite(pred).all(-1).all(-1)
        for name in ("mean", "floor", "bodies"):
            row[name][~finite] = torch.nan
    return {name: torch.stack([row[name] for row in rows]) for name in PENETRATION_METRICS}


def _depths(
    clip: Clip,
    points: Float[Tensor, "step particle 3"],
    others: Sequence[tuple[int, Bool[Tensor, " particle"]]],
    height: float,
) -> tuple[Float[Tensor, " step"], Float[Tensor, " step"]]:
    """Return the deepest point below the floor and in the boxes of other bodies, for each step."""
    assert clip.state is not None
    floor = deepest(below_floor(points, height))
    inside = torch.full((points.shape[0],), torch.nan, dtype=torch.float64)
    poses = clip.poses(points.shape[0])[1:]
    num_true = poses.shape[0]
    for number, shared in others:
        half_size = torch.from_numpy(clip.state.half_sizes[number])
        depth = deepest(inside_box_depth(points[:num_true, ~shared], poses[:, number], half_size))
        inside[:num_true] = torch.fmax(inside[:num_true], depth)
    return floor, inside
