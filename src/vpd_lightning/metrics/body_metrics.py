"""What is measured of one body at each step, beside its true motion; ``registry.py`` lists and describes it all.

Steps behind the end of the recording have no error (NaN), only the values that need no truth; what was predicted in no
numbers has no value at all. A soft body changes its shape, so it has no rigidity error, no size ratio, no orientation.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.metrics import body_dynamics, rigid_motion
from vpd_lightning.metrics.body_track import BodyTrack
from vpd_lightning.metrics.surface_distance import surface_errors

Steps = Float[Tensor, " step"]


def centroid_error(track: BodyTrack) -> Steps:
    """Distance of the centroid from its true place."""
    return track.judged(rigid_motion.centroid_error(track.predicted[: track.num_true], track.true_steps))


def centroid_error_copy(track: BodyTrack) -> Steps:
    """The centroid error of the prediction that nothing moves."""
    return track.padded(rigid_motion.centroid_error(_still(track), track.true_steps))


def centroid_error_constant(track: BodyTrack) -> Steps:
    """The centroid error of the training set's median displacement, the reference without any input."""
    if track.constant is None:
        return track.unknown()
    num_known = min(track.num_true, track.constant.shape[0])
    moved = _still(track)[:num_known] + track.constant[:num_known, None]
    return track.padded(rigid_motion.centroid_error(moved, track.true_steps[:num_known]))


def centroid_error_velocity(track: BodyTrack) -> Steps:
    """The centroid error if the true velocity between the two input frames went on."""
    step = torch.arange(1, track.num_true + 1, dtype=torch.float64)[:, None, None]
    going_on = _still(track) + step * (track.start.mean(0) - track.before.mean(0))
    return track.padded(rigid_motion.centroid_error(going_on, track.true_steps))


def particle_error(track: BodyTrack) -> Steps:
    """Mean distance of the particles from their true places."""
    return track.judged(rigid_motion.particle_error(track.predicted[: track.num_true], track.true_steps))


def particle_error_copy(track: BodyTrack) -> Steps:
    """The particle error of the prediction that nothing moves."""
    return track.padded(rigid_motion.particle_error(_still(track), track.true_steps))


def orientation_error(track: BodyTrack) -> Steps:
    """Angle in degrees between the predicted and the true rotation of a rigid body since the last input frame."""
    if track.is_soft:
        return track.unknown()
    pred = track.predicted[: track.num_true]
    return track.judged(body_dynamics.orientation_error(pred, track.true_steps, track.start))


def velocity_error(track: BodyTrack) -> Steps:
    """Length of the difference of the centroid's velocity over each step."""
    return track.judged((track.velocity[: track.num_true] - track.true_velocity).norm(dim=-1))


def energy_error(track: BodyTrack) -> Steps:
    """Absolute difference of the centroid's kinetic and potential energy, in the middle of each step."""
    predicted = torch.cat([track.start[None], track.predicted[: track.num_true]])
    energies = [
        body_dynamics.specific_energy(places, track.frame_time)
        for places in (predicted, track.true[: track.num_true + 1])
    ]
    error = track.judged((energies[0] - energies[1]).abs())
    return torch.where(track.both_ends_finite, error, torch.nan)


def height_error(track: BodyTrack) -> Steps:
    """Absolute difference of the lowest particle's height."""
    pred = track.predicted[: track.num_true]
    return track.judged((pred[..., 2].amin(-1) - track.true_steps[..., 2].amin(-1)).abs())


def rigidity_error(track: BodyTrack) -> Steps:
    """Root mean square residual of a rigid body after the best rigid motion."""
    return track.unknown() if track.is_soft else track.judged(rigid_motion.rigidity_error(track.predicted, track.start))


def size_ratio(track: BodyTrack) -> Steps:
    """Root mean square radius of a rigid body over that at the start."""
    if track.is_soft:
        return track.unknown()
    return track.judged(rigid_motion.rms_radius(track.predicted) / rigid_motion.rms_radius(track.start))


def lowest_point(track: BodyTrack) -> Steps:
    """Height of the lowest particle."""
    return track.judged(track.predicted[..., 2].amin(-1))


def body_chamfer(track: BodyTrack) -> Steps:
    """Mean distance of a soft body's particles to its true surface; what cameras do not see of it does not count."""
    if track.surface is None:
        return track.unknown()
    surface = track.surface[1 : track.num_true + 1]
    return track.judged(surface_errors(track.predicted[: track.num_true], surface))


def speed(track: BodyTrack) -> Steps:
    """Speed of the centroid over each step."""
    return track.judged(track.velocity.norm(dim=-1))


def vertical_velocity(track: BodyTrack) -> Steps:
    """Vertical velocity of the centroid over each step."""
    return track.judged(track.velocity[:, 2])


def true_speed(track: BodyTrack) -> Steps:
    """True speed of the centroid over each step."""
    return track.padded(track.true_velocity.norm(dim=-1))


def true_vertical_velocity(track: BodyTrack) -> Steps:
    """True vertical velocity of the centroid over each step."""
    return track.padded(track.true_velocity[:, 2])


def _still(track: BodyTrack) -> Float[Tensor, "true_step particle 3"]:
    return track.start.expand_as(track.true_steps)
