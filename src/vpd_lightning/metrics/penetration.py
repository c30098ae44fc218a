"""How deep points lie in what is solid. World frame, metres; 0 where they are outside."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.geometry.rotations import rotation_matrix
from vpd_lightning.metrics.body_track import BodyTrack


def below_floor(points: Float[Tensor, "*shape particle 3"], height: float) -> Float[Tensor, "*shape particle"]:
    """Depth of each point below a level floor at ``height`` (z is up)."""
    return (height - points[..., 2]).clamp(min=0.0)


def inside_box_depth(
    points: Float[Tensor, "step particle 3"], poses: Float[Tensor, "step 7"], half_size: Float[Tensor, " 3"]
) -> Float[Tensor, "step particle"]:
    """Depth of each point in an oriented box that moves: its distance to the nearest face."""
    local = (points - poses[:, None, :3]) @ rotation_matrix(poses[:, 3:])
    return (half_size - local.abs()).amin(-1).clamp(min=0.0)


def deepest(depths: Float[Tensor, "*shape particle"]) -> Float[Tensor, "*shape"]:
    """Depth of the deepest of some points; 0 for none."""
    if depths.shape[-1] == 0:
        return depths.new_zeros(depths.shape[:-1])
    return torch.amax(depths, -1)


def penetration_by_step(track: BodyTrack) -> dict[str, Float[Tensor, " step"]]:
    """Depth of the deepest particle below the ``floor``, in other ``bodies``, and the larger of the two: ``mean``.

    Other bodies count by their true boxes (the box of a round body is larger than it is), but not for particles that
    start in them, which may be their own. ``true_motion`` is what the larger would be if the particles followed the
    truth: they are where cameras and encoder put them, so it need not be 0. NaN where nothing is known: no floor seen,
    no other rigid body, or the end of the recording.
    """
    floor, bodies = _depths(track, track.predicted)
    return {
        "mean": track.judged(torch.fmax(floor, bodies)),
        "floor": track.judged(floor),
        "bodies": track.judged(bodies),
        "true_motion": track.padded(torch.fmax(*_depths(track, track.true_steps))),
    }


def _depths(
    track: BodyTrack, points: Float[Tensor, "step particle 3"]
) -> tuple[Float[Tensor, " step"], Float[Tensor, " step"]]:
    """Return the deepest point below the floor and in the boxes of other bodies, for each step."""
    floor = deepest(below_floor(points, track.floor_height))
    inside = torch.full((points.shape[0],), torch.nan, dtype=torch.float64)
    for box in track.obstacles:
        poses = box.poses[: points.shape[0]]
        depth = deepest(inside_box_depth(points[: len(poses), ~box.shared], poses, box.half_size))
        inside[: len(poses)] = torch.fmax(inside[: len(poses)], depth)
    return floor, inside
