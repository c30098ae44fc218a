"""Fits the light before training, from pairs of frames of the training recordings."""

import logging
from collections.abc import Sequence
from typing import Any

import torch

from vpd_lightning.data.collate import driven_tensors
from vpd_lightning.data.dataset import require_clips
from vpd_lightning.data.frame_source import FrameSource
from vpd_lightning.errors import ConfigError, EmptyWorkspaceError
from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.randomness import RandomKeys, derive_seed, numpy_generator
from vpd_lightning.renderer.light_fit import USEFUL, LightPair, fit_light, light_pair
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.simulator import Simulator
from vpd_lightning.types import Cameras, Rays, RGBDFrames

log = logging.getLogger(__name__)


def fit_light_of(
    system: Any, trajectories: Sequence[FrameSource], views: Sequence[int], seed: int, num_pairs: int, num_updates: int
) -> float | None:
    """Fit the lights of a system that has some; return the share of the squared error that is left.

    None: it has none that learn, or nothing that stands still was seen to change in ``num_pairs`` pairs of frames.
    Then, and where the fit explains hardly anything, the lights begin as they were. Draws depend on ``seed`` alone.

    Raises:
        ConfigError: fewer than one pair or update.
        DataError: a recording lacks one of the views.
    """
    if num_pairs < 1 or num_updates < 1:
        raise ConfigError(
            f"light_fit needs at least one pair and one update, got num_pairs={num_pairs}, num_updates={num_updates}.\n"
            "Set light_fit.num_pairs=0 to leave it out."
        )
    if not isinstance(system, Simulator) or not isinstance(system.renderer, SplatRenderer):
        return None
    shadows = system.renderer.shadows
    if shadows is None or not shadows.shares.requires_grad:
        return None
    require_clips(trajectories, 1, views, None)
    draw = numpy_generator(seed, "light")
    generator = torch.Generator().manual_seed(derive_seed(seed, "light"))
    pairs: list[LightPair] = []
    for number in range(num_pairs):
        trajectory = trajectories[int(draw.integers(len(trajectories)))]
        first, second = (int(time) for time in draw.integers(trajectory.num_frames, size=2))
        found = _pair(
            system, system.renderer, trajectory, first, second, views, RandomKeys(seed, number, [0]), generator
        )
        pairs += [] if found is None else [found]
    if not pairs:
        log.warning("the light was not fitted: nothing that stands still changed between frames")
        return None
    left = fit_light(shadows, pairs, num_updates, generator)
    used = "" if left < USEFUL else "; not used"
    log.info("light fitted to %d pairs of frames: %.0f %% of the squared error is left%s", len(pairs), 100 * left, used)
    return left


@torch.no_grad()
def _pair(
    simulator: Simulator,
    renderer: SplatRenderer,
    trajectory: FrameSource,
    first: int,
    second: int,
    views: Sequence[int],
    keys: RandomKeys,
    generator: torch.Generator,
) -> LightPair | None:
    frames = [_frames(trajectory, time, views) for time in (first, second)]
    try:
        before, after = (simulator.encoder(shown, keys, "current").particles for shown in frames)
    except EmptyWorkspaceError:  # a frame without depth, which no clip may ever use
        return None
    rays = pixel_rays(frames[1].cameras)
    flat = Rays(rays.origins.flatten(0, -2), rays.directions.flatten(0, -2))
    return light_pair(renderer, before, after, flat, frames[1].rgb.flatten(0, -2), generator)


def _frames(trajectory: FrameSource, time: int, views: Sequence[int]) -> RGBDFrames:
    """Return one time step with a batch axis of 1."""
    intrinsics, cam_to_world = (
        torch.from_numpy(values[0]).float()[None] for values in trajectory.cameras([time], views)
    )
    rgb, depth = (
        torch.from_numpy(values) for values in (trajectory.rgb([time], views), trajectory.depth([time], views))
    )
    cameras = Cameras(intrinsics, cam_to_world, trajectory.height, trajectory.width)
    return RGBDFrames(rgb.float() / 255, depth, cameras, driven_tensors(trajectory.driven([time])))
