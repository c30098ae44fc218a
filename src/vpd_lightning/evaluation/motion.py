"""Predicted particles against ground truth: the metric alone knows the true poses, the model never does."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.data.clip import Clip
from vpd_lightning.evaluation.bodies import Body, find_bodies, surface_errors
from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.geometry.workspace import inside_workspace
from vpd_lightning.metrics.body_dynamics import centroid_velocity, orientation_error, specific_energy
from vpd_lightning.metrics.chamfer import ChamferDistance, chamfer
from vpd_lightning.metrics.rigid_motion import centroid_error, particle_error, rigidity_error, rms_radius
from vpd_lightning.types import Particles

MIN_BODY_PARTICLES = 5
PREDICTION_METRICS = (
    "centroid_error", "particle_error", "orientation_error", "velocity_error", "energy_error", "height_error",
    "rigidity_error", "size_ratio", "lowest_point", "body_chamfer", "speed", "vertical_velocity",
)  # fmt: skip
REFERENCE_METRICS = ("centroid_error_constant", "centroid_error_copy", "particle_error_copy", "centroid_error_velocity")
TRUTH = ("true_speed", "true_vertical_velocity")
MOTION_METRICS = (*PREDICTION_METRICS, *REFERENCE_METRICS, *TRUTH)


def valid_positions(particles: Particles) -> Float[Tensor, "particle 3"]:
    """Positions of the particles that are there, in float64 on the CPU (batch axis of 1 or none)."""
    positions, mask = particles.positions, particles.mask
    if positions.dim() == 3:
        positions, mask = positions[0], mask[0]
    return positions[mask].detach().to("cpu", torch.float64)


def trajectory_of(current: Particles, states: Sequence[Particles]) -> Float[Tensor, "time particle 3"]:
    """Positions over time, the last observed ones first; particle i keeps its index through a rollout."""
    return torch.stack([valid_positions(state) for state in (current, *states)])


def body_motion(
    positions: Float[Tensor, "time particle 3"],
    body: Body,
    constant: Float[Tensor, "step 3"] | None,
    frame_time: float,
) -> dict[str, Float[Tensor, " step"]]:
    """Judge the particles of one body (``positions``, observed first) against its true motion.

    Values are metres, metres per second, degrees (``orientation_error``) and joules per kilogram (``energy_error``);
    velocities and energies are those of the centroid over each step. Steps beyond the recording have no error (NaN),
    only the values that need no truth; a prediction that is not finite has no value at all. A soft body changes its
    shape, so it has no rigidity error, no size ratio and no orientation; ``body_chamfer`` is the mean distance of its
    particles to its true surface (what cameras do not see of it does not count). ``constant`` is the median
    displacement of the training set, the reference that knows no input; "copy" predicts that nothing moves, "velocity"
    that the true velocity between the two input frames goes on.
    """
    start, pred = positions[0], positions[1:]
    finite = torch.isfinite(pred).all(-1).all(-1)
    pred = torch.where(finite[:, None, None], pred, start)
    num_steps, num_true = pred.shape[0], min(pred.shape[0], body.true.shape[0] - 1)
    values = {name: torch.full((num_steps,), torch.nan, dtype=torch.float64) for name in MOTION_METRICS}
    if not body.is_soft:
        values["rigidity_error"] = rigidity_error(pred, start)
        values["size_ratio"] = rms_radius(pred) / rms_radius(start)
    values["lowest_point"] = pred[..., 2].amin(-1)
    velocity = centroid_velocity(torch.cat([start[None], pred]), frame_time)
    values["speed"], values["vertical_velocity"] = velocity.norm(dim=-1), velocity[:, 2]
    if num_true > 0:
        true = body.true[1 : num_true + 1]
        still = start.expand_as(true)
        values["centroid_error"][:num_true] = centroid_error(pred[:num_true], true)
        values["particle_error"][:num_true] = particle_error(pred[:num_true], true)
        values["centroid_error_copy"][:num_true] = centroid_error(still, true)
        values["particle_error_copy"][:num_true] = particle_error(still, true)
        values["height_error"][:num_true] = (pred[:num_true, :, 2].amin(-1) - true[..., 2].amin(-1)).abs()
        predicted, real = torch.cat([start[None], pred[:num_true]]), body.true[: num_true + 1]
        true_velocity = centroid_velocity(real, frame_time)
        values["true_speed"][:num_true] = true_velocity.norm(dim=-1)
        values["true_vertical_velocity"][:num_true] = true_velocity[:, 2]
        values["velocity_error"][:num_true] = (velocity[:num_true] - true_velocity).norm(dim=-1)
        energies = [specific_energy(places, frame_time) for places in (predicted, real)]
        values["energy_error"][:num_true] = (energies[0] - energies[1]).abs()
        step = torch.arange(1, num_true + 1, dtype=torch.float64)[:, None, None]
        going_on = still + step * (start.mean(0) - body.before.mean(0))
        values["centroid_error_velocity"][:num_true] = centroid_error(going_on, true)
        if not body.is_soft:
            values["orientation_error"][:num_true] = orientation_error(pred[:num_true], true, start)
        if body.surface is not None:
            values["body_chamfer"][:num_true] = surface_errors(pred[:num_true], body.surface[1 : num_true + 1])
        if constant is not None:
            num_known = min(num_true, constant.shape[0])
            moved = still[:num_known] + constant[:num_known, None]
            values["centroid_error_constant"][:num_known] = centroid_error(moved, true[:num_known])
    for name in PREDICTION_METRICS:
        values[name][~finite] = torch.nan
    for name in ("speed", "vertical_velocity", "velocity_error", "energy_error"):
        values[name][1:][~finite[:-1]] = torch.nan  # the step before was made up
    return values


def clip_motion(
    clip: Clip,
    positions: Float[Tensor, "time particle 3"],
    margin: float,
    constants: Float[Tensor, "step object 3"] | None,
) -> tuple[dict[str, Float[Tensor, "object step"]], Bool[Tensor, "object particle"]]:
    """Find the bodies of a clip and judge them; returns their motion and their particles."""
    bodies = find_bodies(clip, positions[0], margin, positions.shape[0] - 1)
    motion = bodies_motion(bodies, positions, constants, clip.frame_time)
    return motion, torch.stack([body.mask for body in bodies])


def bodies_motion(
    bodies: Sequence[Body],
    positions: Float[Tensor, "time particle 3"],
    constants: Float[Tensor, "step object 3"] | None,
    frame_time: float,
) -> dict[str, Float[Tensor, "object step"]]:
    """Judge every body; NaN for one that the particles hardly show (fewer than 5 of them)."""
    rows = []
    for index, body in enumerate(bodies):
        constant = None if constants is None or index >= constants.shape[1] else constants[:, index]
        if body.mask.sum() >= MIN_BODY_PARTICLES:
            rows.append(body_motion(positions[:, body.mask], body, constant, frame_time))
        else:
            missing = torch.full((positions.shape[0] - 1,), torch.nan, dtype=torch.float64)
            rows.append(dict.fromkeys(MOTION_METRICS, missing))
    return {name: torch.stack([row[name] for row in rows]) for name in MOTION_METRICS}


def chamfer_to_depth(clip: Clip, step: int, pred: Float[Tensor, "particle 3"], max_points: int) -> ChamferDistance:
    """Chamfer distance from particles to the true surface: the unprojected depth of all cameras inside the workspace.

    At most ``max_points`` true points count, taken evenly over the pixels. Particles see the input views only, so the
    completeness of a model with few input views contains what those cannot see.
    """
    if not bool(torch.isfinite(pred).all()):
        return ChamferDistance(float("nan"), float("nan"))
    depth = clip.target_depth[step]
    points = unproject(depth, clip.target_cameras[step])
    seen = torch.isfinite(depth) & (depth > 0)
    points = points[seen]
    points = points[inside_workspace(points, clip.workspace_min, clip.workspace_max)]
    if points.shape[0] > max_points:
        points = points[torch.linspace(0, points.shape[0] - 1, max_points).long()]
    return chamfer(pred, points)
