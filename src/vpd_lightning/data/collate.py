"""Training samples to batches."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vpd_lightning.data.driven_motion import DrivenMotion
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import NUM_CONTEXT_FRAMES, Cameras, Driven, Rays, RGBDFrames, VideoBatch


@dataclass(frozen=True)
class ClipSample:
    """One member of a batch, as a loader worker makes it; ``step`` and ``sample_index`` say which one.

    The time axis holds the two context frames, and behind them the frames to predict where those are loaded.
    """

    rgb: UInt8[Tensor, "time view height width 3"]
    depth: Float[Tensor, "time view height width"]
    intrinsics: Float[Tensor, "time view 3 3"]
    cam_to_world: Float[Tensor, "time view 4 4"]
    origins: Float[Tensor, "step ray 3"]
    directions: Float[Tensor, "step ray 3"]
    rgbs: Float[Tensor, "step ray 3"]
    seed: int
    step: int
    sample_index: int
    clip: str
    driven: Driven | None = None  # at the context frames and at those to predict (axis ``time``)


def collate_clips(samples: Sequence[ClipSample]) -> VideoBatch:
    """Stack samples of one training step to a batch."""
    steps = {sample.step for sample in samples}
    if len(steps) != 1:
        raise ValueError(f"a batch holds samples of one training step, got steps {sorted(steps)}")

    def stack(name: str) -> Tensor:
        return torch.stack([getattr(sample, name) for sample in samples])

    height, width = samples[0].depth.shape[-2:]
    cameras = Cameras(stack("intrinsics"), stack("cam_to_world"), height, width)
    driven = _stacked([sample.driven for sample in samples])
    num_frames = samples[0].depth.shape[0]
    seen = None if driven is None else driven[:, :num_frames]
    frames = RGBDFrames(stack("rgb"), stack("depth"), cameras, seen)
    has_future = frames.depth.shape[1] > NUM_CONTEXT_FRAMES
    return VideoBatch(
        context=frames[:, :NUM_CONTEXT_FRAMES],
        future=frames[:, NUM_CONTEXT_FRAMES:] if has_future else None,
        rays=Rays(stack("origins"), stack("directions")),
        rgbs=stack("rgbs"),
        keys=RandomKeys(samples[0].seed, samples[0].step, [sample.sample_index for sample in samples]),
        clips=[sample.clip for sample in samples],
        driven=None if driven is None else driven[:, NUM_CONTEXT_FRAMES:],
    )


def driven_tensors(motion: DrivenMotion | None) -> Driven | None:
    """Return what a simulator is given of a recorded motion (axes ``step driven``)."""
    return None if motion is None else Driven.from_arrays(motion.points, motion.normals, motion.groups)


def _stacked(motions: Sequence[Driven | None]) -> Driven | None:
    """Return given motions as one batch, those of fewer points padded; None where no recording has one."""
    known = [motion for motion in motions if motion is not None]
    if not known:
        return None
    most = max(motion.positions.shape[-2] for motion in known)
    empty = known[0][:, :0]

    def padded(motion: Driven) -> Driven:
        missing = most - motion.mask.shape[-1]
        return motion.mapped(lambda values: torch.cat([values, _zeros(values, missing)], dim=1))

    members = [padded(empty if motion is None else motion) for motion in motions]
    names = ("positions", "normals", "groups", "mask")
    return Driven(*(torch.stack([getattr(member, name) for member in members]) for name in names))


def _zeros(like: Tensor, count: int) -> Tensor:
    return like.new_zeros(like.shape[0], count, *like.shape[2:])
