"""Actions: a motion that is given, checked and handed to the dynamics step by step."""

from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from vpd_lightning.errors import ActionError
from vpd_lightning.geometry.driven_pixels import seen_through_share
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Driven, Particles, RGBDFrames, mapped_tensors

Tree = TypeVar("Tree")

MAX_STEP = 0.5
"""Metres: what a driven point moves farther in one step is a mistake of units, frames or order."""

_MOST_SEEN_THROUGH = 0.3
"""Share of the driven points that cameras may see through; the rest is errors of calibration and thin parts."""

_MAX_LENGTH_ERROR = 1e-2  # of normals


def checked_motion(particles: Particles, motion: Driven, num_steps: int) -> Driven:
    """Return a motion with axes ``batch step driven``, on the device of the particles that it is to move beside.

    ``motion`` has axes ``step driven`` or ``batch step driven``; a batch of particles of one may meet any number of
    motions.

    Raises:
        ActionError: it is shorter than ``num_steps``, not finite, of other points than the scene's, or jumps.
    """
    here = particles.driven
    if here is None:
        raise ActionError(
            "a motion is given, but the scene was encoded without what is driven.\n"
            "Encode it with where that was in both frames: encode(rgb, depth, cameras, driven=motion[:2])."
        )
    if motion.positions.dim() == 3:
        motion = motion.mapped(lambda values: values[None])
    if motion.positions.dim() != 4:
        shape = tuple(motion.positions.shape)
        raise ActionError(f"a motion must be (step, point, 3) or (batch, step, point, 3), got {shape}.")
    motion = motion.to(here.positions.device, here.positions.dtype)
    batch_size, steps, count = motion.mask.shape
    if steps < num_steps:
        raise ActionError(
            f"the motion has {steps} steps, but {num_steps} are to be predicted.\n"
            f"Give it for all of them, or predict {steps}."
        )
    if count != here.mask.shape[-1]:
        raise ActionError(
            f"the motion is of {count} points, that of the scene of {here.mask.shape[-1]}.\n"
            "Sample the points of a robot once, and move the same ones."
        )
    if batch_size != len(here.mask) and len(here.mask) != 1:
        raise ActionError(f"{batch_size} motions do not fit a batch of {len(here.mask)} scenes.")
    motion = motion[:, :num_steps]
    if not bool(torch.isfinite(motion.positions[motion.mask]).all()):
        raise ActionError("the motion has positions that are not finite.\nSee what made them, or end it before them.")
    lengths = motion.normals.norm(dim=-1)[motion.mask]
    if not bool(((lengths - 1).abs() < _MAX_LENGTH_ERROR).all()):
        raise ActionError("the motion has normals that are not of unit length.\nDivide them by their lengths.")
    places = torch.cat([here.positions.expand(batch_size, -1, -1)[:, None], motion.positions], dim=1)
    jumps = places.diff(dim=1).norm(dim=-1) * motion.mask
    farthest = float(jumps.max()) if jumps.numel() else 0.0
    if farthest > MAX_STEP:
        step = int(jumps.flatten(2).amax(dim=(0, 2)).argmax())
        raise ActionError(
            f"a driven point moves {farthest:.3g} m in step {step} of the motion (from 0); the most is {MAX_STEP} m.\n"
            "Give positions in metres, in the world frame of the cameras, from one step after the current frame on."
        )
    return motion


def check_frame(frames: RGBDFrames) -> None:
    """Refuse what is driven where the cameras of the frames (axes ``batch view``) see through it.

    Raises:
        ActionError: it is not finite, or it is not where it is said to be.
    """
    driven = frames.driven
    if driven is None:
        return
    if not bool(torch.isfinite(driven.positions[driven.mask]).all()):
        raise ActionError("what is driven has positions that are not finite in the observed frames.")
    share = float(seen_through_share(frames).max()) if driven.mask.any() else 0.0
    if share > _MOST_SEEN_THROUGH:
        raise ActionError(
            f"the cameras see through {share:.0%} of the driven points: what is driven is not where it is said to be.\n"
            "Give its points in the world frame of the cameras, in metres, at the times of the two frames."
        )


def with_next(particles: Particles, following: Driven | None) -> Particles:
    """Return the particles with where what is driven will be after the step; without ``following`` it stays."""
    driven = particles.driven
    if driven is None:
        return particles
    return replace(particles, driven=driven.towards(driven if following is None else following))


def after_step(following: Particles, current: Particles) -> Particles:
    """Return the predicted particles with what is driven where it was given to be, whatever the dynamics returned."""
    if current.driven is None:
        return following
    return replace(following, driven=current.driven.advanced())


def expanded(tree: Tree, count: int) -> Tree:
    """Return tensors and dataclasses of tensors, whose batch axis of 1 is expanded to ``count``; nothing is copied.

    The draws of keys become the same for all: each member is what it would be alone.
    """
    if isinstance(tree, RandomKeys):
        return replace(tree, sample_index=list(tree.sample_index) * count)

    def grown(values: Tensor) -> Tensor:
        return values.expand(count, *values.shape[1:]) if values.dim() and len(values) == 1 else values

    return mapped_tensors(grown, tree)  # type: ignore[no-any-return]
