"""Which observed particles show which true body, and where its true motion carries them."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.data.clip import Clip
from vpd_lightning.metrics.rigid_motion import inside_box, move_with_body
from vpd_lightning.metrics.surface_distance import SurfacePoints, nearest_on_surface, surface_of


@dataclass(frozen=True)
class Body:
    """One true body of a clip. ``mask`` are its particles, chosen by where they are at the last input frame.

    ``true`` is where its motion carries them from that frame on, as far as the recording goes: rigidly by the change of
    pose, or for a soft body with the points of its surface that are nearest to them. ``surface`` are a soft body's
    true triangles over the same time, None for a rigid one. ``before`` is where they were one frame earlier, at the
    first input frame.
    """

    mask: Bool[Tensor, " particle"]
    true: Float[Tensor, "true_time body_particle 3"]
    surface: Float[Tensor, "true_time triangle 3 3"] | None
    before: Float[Tensor, "body_particle 3"]

    @property
    def is_soft(self) -> bool:
        return self.surface is not None


def find_bodies(clip: Clip, positions: Float[Tensor, "particle 3"], margin: float, num_steps: int) -> list[Body]:
    """Find the particles (at the last input frame) of every true body, and their true motion over ``num_steps`` steps.

    A rigid body's particles lie in its true box grown by ``margin`` metres, a soft body's within ``margin`` of its true
    surface and nearer to it than to that of another soft body.
    """
    assert clip.state is not None
    poses, previous, half_sizes = clip.poses(num_steps), clip.previous_pose(), torch.from_numpy(clip.state.half_sizes)
    soft = _soft_bodies(clip, positions, margin, num_steps)
    bodies = []
    for number, half_size in enumerate(half_sizes):
        if number in soft:
            bodies.append(soft[number])
            continue
        pose = poses[:, number]
        mask = inside_box(positions, pose[0], half_size, margin)
        true = move_with_body(positions[mask], pose[0], pose)
        bodies.append(Body(mask, true, None, move_with_body(positions[mask], pose[0], previous[number][None])[0]))
    return bodies


def _soft_bodies(clip: Clip, positions: Float[Tensor, "particle 3"], margin: float, num_steps: int) -> dict[int, Body]:
    """Return the bodies that have vertices, by the number of the object."""
    state = clip.state
    if state is None or state.vertices is None or state.vertex_objects is None or state.tetrahedra is None:
        return {}
    # The frame before the last input frame, that frame, and those to predict.
    vertices = state.vertices[clip.current_frame - 1 : clip.current_frame + num_steps + 1].astype(np.float64)
    triangles = surface_of(state.tetrahedra)
    numbers = np.unique(state.vertex_objects).tolist()
    surfaces = [vertices[:, triangles[state.vertex_objects[triangles[:, 0]] == number]] for number in numbers]
    found = [_near_surface(positions.numpy(), surface[1], margin) for surface in surfaces]
    distances = np.stack([distance for distance, _ in found])
    bodies = {}
    for row, (number, surface) in enumerate(zip(numbers, surfaces, strict=True)):
        distance, near = found[row]
        mask = (distance <= margin) & (distances.argmin(axis=0) == row)
        near = near.of(mask[np.isfinite(distance)])
        corners = surface[:, near.triangle]
        moved = np.einsum("tpck,pc->tpk", corners - corners[1:2], near.weights)
        places = positions[torch.from_numpy(mask)] + torch.from_numpy(moved)
        bodies[number] = Body(torch.from_numpy(mask), places[1:], torch.from_numpy(surface[1:]), places[0])
    return bodies


def _near_surface(
    points: NDArray[np.float64], corners: NDArray[np.float64], margin: float
) -> tuple[NDArray[np.float64], SurfacePoints]:
    """Return the distance of every point to a surface, infinite beyond its box grown by ``margin``, and what is near.

    The second covers the points with a finite distance only.
    """
    low, high = corners.min(axis=(0, 1)) - margin, corners.max(axis=(0, 1)) + margin
    inside = ((points >= low) & (points <= high)).all(axis=1)
    near = nearest_on_surface(points[inside], corners)
    distance = np.full(len(points), np.inf)
    distance[inside] = near.distance
    return distance, near
