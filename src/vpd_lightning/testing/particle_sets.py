"""The same particles in another form: other slots, padding, a shifted world, one member, fewer of them."""

from collections.abc import Callable
from dataclasses import fields, replace

import torch
from jaxtyping import Int
from torch import Tensor

from vpd_lightning.types import OTHER_AXES, Particles, Rays

SHIFT = (3.0, -2.0, 1.0)  # metres
_NUM_PADDING = 3  # slots before the particles, and as many behind them


def mapped(particles: Particles, function: Callable[[Tensor], Tensor]) -> Particles:
    """Apply a function to every tensor of the particles."""
    return particles.mapped(function)


def member(particles: Particles, index: int) -> Particles:
    """Return one member of the batch, as a batch of one."""
    scenery = None if particles.scenery is None else particles.scenery[index : index + 1]
    driven = None if particles.driven is None else particles.driven[index : index + 1]
    return replace(mapped(particles, lambda values: values[index : index + 1]), scenery=scenery, driven=driven)


def reordered(particles: Particles, order: Int[Tensor, " particle"]) -> Particles:
    """Return the particles in other slots."""
    return mapped(particles, lambda values: values[:, order])


def first(particles: Particles, count: int) -> Particles:
    """Return the first slots only."""
    return mapped(particles, lambda values: values[:, :count])


def shifted(particles: Particles) -> Particles:
    """Return the particles, and what is driven, somewhere else in the world."""
    shift = particles.positions.new_tensor(SHIFT)
    driven = particles.driven
    if driven is not None:
        there = None if driven.next_positions is None else driven.next_positions + shift
        driven = replace(driven, positions=driven.positions + shift, next_positions=there)
    return replace(particles, positions=particles.positions + shift, driven=driven)


def shifted_rays(rays: Rays) -> Rays:
    """Return the rays at the place of the shifted particles."""
    return Rays(rays.origins + rays.origins.new_tensor(SHIFT), rays.directions)


def only_valid(particles: Particles, count: int) -> Particles:
    """Return the particles with all but the first ``count`` slots as padding; what lies in the padding stays."""
    mask = particles.mask & (torch.arange(particles.num_particles, device=particles.mask.device) < count)
    return replace(particles, mask=mask)


def padded_far(particles: Particles) -> Particles:
    """Return the particles with padding before and behind them that holds large finite numbers."""

    def with_padding(values: Tensor) -> Tensor:
        shape = (values.shape[0], _NUM_PADDING, *values.shape[2:])
        junk = torch.full(shape, 40.0 if values.is_floating_point() else True, dtype=values.dtype, device=values.device)
        return torch.cat([junk, values, junk], dim=1)

    return _with_padding_masked(mapped(particles, with_padding))


def padded_inside(particles: Particles) -> Particles:
    """Return the particles with padding that lies among them: neighbours of all, were it not for the mask."""
    moved = replace(
        particles,
        positions=particles.positions + 0.02,
        features=1.0 - particles.features,
        moving=None if particles.moving is None else torch.ones_like(particles.moving),
    )
    parts = [first(moved, _NUM_PADDING), particles, mapped(moved, lambda values: values[:, -_NUM_PADDING:])]

    def joined(name: str) -> Tensor | None:
        values = [getattr(part, name) for part in parts]
        return None if values[0] is None else torch.cat(values, dim=1)

    names = [item.name for item in fields(Particles) if item.name not in OTHER_AXES]
    wide = Particles(**{name: joined(name) for name in names}, scenery=particles.scenery, driven=particles.driven)
    return _with_padding_masked(wide)


PADDINGS = {"far away": padded_far, "among the particles": padded_inside}


def _with_padding_masked(wide: Particles) -> Particles:
    mask = wide.mask.clone()
    mask[:, :_NUM_PADDING] = False
    mask[:, -_NUM_PADDING:] = False
    return replace(wide, mask=mask)


def without_padding(particles: Particles) -> Particles:
    """Return the slots that padding did not add."""
    return mapped(particles, lambda values: values[:, _NUM_PADDING:-_NUM_PADDING])
