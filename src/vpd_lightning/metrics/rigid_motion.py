"""Motion of a rigid body's particles against its true poses. World frame, metres; quaternions are w x y z."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.geometry.rotations import rotation_matrix
from vpd_lightning.metrics.body_dynamics import best_rotation


def to_body_frame(points: Float[Tensor, "particle 3"], pose: Float[Tensor, " 7"]) -> Float[Tensor, "particle 3"]:
    """Express world points in the frame of a body; ``pose`` is position then quaternion."""
    return (points - pose[:3]) @ rotation_matrix(pose[3:])


def to_world_frame(points: Float[Tensor, "particle 3"], pose: Float[Tensor, " 7"]) -> Float[Tensor, "particle 3"]:
    """Express points of a body's frame in the world; the inverse of ``to_body_frame``."""
    return points @ rotation_matrix(pose[3:]).T + pose[:3]


def inside_box(
    points: Float[Tensor, "particle 3"], pose: Float[Tensor, " 7"], half_size: Float[Tensor, " 3"], margin: float
) -> Bool[Tensor, " particle"]:
    """Which points lie in the oriented box grown by ``margin`` on every side."""
    return (to_body_frame(points, pose).abs() <= half_size + margin).all(-1)


def move_with_body(
    points: Float[Tensor, "particle 3"], start: Float[Tensor, " 7"], poses: Float[Tensor, "step 7"]
) -> Float[Tensor, "step particle 3"]:
    """Where points fixed to a body at pose ``start`` are at each later pose."""
    local = to_body_frame(points, start)
    return torch.stack([to_world_frame(local, pose) for pose in poses])


def centroid_error(
    pred: Float[Tensor, "step particle 3"], true: Float[Tensor, "step particle 3"]
) -> Float[Tensor, " step"]:
    """Distance in metres between the centroids of corresponding particles, one value per step."""
    return (pred.mean(1) - true.mean(1)).norm(dim=-1)


def particle_error(
    pred: Float[Tensor, "step particle 3"], true: Float[Tensor, "step particle 3"]
) -> Float[Tensor, " step"]:
    """Mean distance in metres between corresponding particles, one value per step."""
    return (pred - true).norm(dim=-1).mean(-1)


def rms_radius(points: Float[Tensor, "*shape particle 3"]) -> Float[Tensor, "*shape"]:
    """Root mean square distance to the centroid in metres: a rigid motion leaves it alone."""
    return (points - points.mean(-2, keepdim=True)).square().sum(-1).mean(-1).sqrt()


def rigidity_error(
    pred: Float[Tensor, "step particle 3"], start: Float[Tensor, "particle 3"]
) -> Float[Tensor, " step"]:
    """Root mean square residual in metres after the best rigid motion from ``start`` (Kabsch 1976) is taken out."""
    centred, target = start - start.mean(0), pred - pred.mean(1, keepdim=True)
    turned = torch.einsum("sij,pj->spi", best_rotation(start, pred), centred)
    return (target - turned).square().sum(-1).mean(-1).sqrt()
