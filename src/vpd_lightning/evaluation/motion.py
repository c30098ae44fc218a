"""Predicted particles beside ground truth: only the metrics read the true poses."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.data.clip import Clip
from vpd_lightning.evaluation.bodies import Body, find_bodies
from vpd_lightning.evaluation.penetration import floor_height, obstacles
from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.geometry.workspace import inside_workspace
from vpd_lightning.metrics.body_track import BodyTrack, measure_bodies
from vpd_lightning.metrics.registry import motion_metrics
from vpd_lightning.types import Particles


def valid_positions(particles: Particles) -> Float[Tensor, "particle 3"]:
    """Positions of the particles that are there, in float64 on the CPU (batch axis of 1 or none)."""
    positions, mask = particles.positions, particles.mask
    if positions.dim() == 3:
        positions, mask = positions[0], mask[0]
    return positions[mask].detach().to("cpu", torch.float64)


def trajectory_of(current: Particles, states: Sequence[Particles]) -> Float[Tensor, "time particle 3"]:
    """Positions over time, the last observed ones first; particle i keeps its index through a rollout."""
    return torch.stack([valid_positions(state) for state in (current, *states)])


def body_tracks(
    clip: Clip,
    bodies: Sequence[Body],
    positions: Float[Tensor, "time particle 3"],
    constants: Float[Tensor, "step object 3"] | None,
) -> list[BodyTrack]:
    """Return every body's particles (``positions``, observed first) beside its true motion and what stands around it.

    ``constants`` are the median displacements of the training set, the reference without any input.
    """
    height = floor_height(clip)
    tracks = []
    for number, body in enumerate(bodies):
        constant = None if constants is None or number >= constants.shape[1] else constants[:, number]
        tracks.append(
            BodyTrack(
                positions=positions[:, body.mask],
                true=body.true,
                before=body.before,
                surface=body.surface,
                constant=constant,
                frame_time=clip.frame_time,
                floor_height=height,
                obstacles=obstacles(clip, bodies, number, positions.shape[0] - 1),
            )
        )
    return tracks


def clip_motion(
    clip: Clip,
    positions: Float[Tensor, "time particle 3"],
    margin: float,
    constants: Float[Tensor, "step object 3"] | None,
) -> tuple[dict[str, Float[Tensor, "object step"]], Bool[Tensor, "object particle"]]:
    """Find the bodies of a clip and judge them; returns their motion and their particles."""
    bodies = find_bodies(clip, positions[0], margin, positions.shape[0] - 1)
    tracks = body_tracks(clip, bodies, positions, constants)
    motion = {info.name: measure_bodies(info, tracks)[info.part_names[0]] for info in motion_metrics()}
    return motion, torch.stack([body.mask for body in bodies])


def true_points(clip: Clip, step: int, max_points: int) -> Float[Tensor, "point 3"]:
    """Points of the true surface: the unprojected depth of all cameras inside the workspace.

    At most ``max_points``, taken evenly over the pixels. Particles see the input views only, so the completeness of a
    model with few input views contains what those cannot see.
    """
    depth, cameras = clip.true_depth(step + 1)
    points = unproject(depth, cameras)
    seen = torch.isfinite(depth) & (depth > 0)
    points = points[seen]
    points = points[inside_workspace(points, clip.workspace_min, clip.workspace_max)]
    if points.shape[0] > max_points:
        points = points[torch.linspace(0, points.shape[0] - 1, max_points).long()]
    return points
