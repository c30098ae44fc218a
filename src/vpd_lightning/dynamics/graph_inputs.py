"""What a graph network is given of particles and of what is driven: rows in use, zeros in padding, plain tensors."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.types import Driven, Particles


def usable(particles: Particles | Driven, name: str) -> Float[Tensor, "node any"]:
    """Return one field, flat, with zeros for padding, whose numbers must not get anywhere, not even as NaN times 0."""
    return torch.where(particles.mask[..., None], getattr(particles, name), 0.0).flatten(0, 1)


def rows_in_use(particles: Particles) -> Particles:
    """Return places, features and mask up to the last particle that is valid in any member (at least one row)."""
    used = particles.mask.any(dim=0).nonzero()
    count = int(used[-1]) + 1 if len(used) else 1
    if count >= particles.num_particles:
        return particles
    return Particles(particles.positions[:, :count], particles.features[:, :count], particles.mask[:, :count])


def driven_tensors(driven: Driven | None) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor] | None:
    """Return positions, normals, groups, mask and next positions, which a compiler can trace."""
    if driven is None:
        return None
    return driven.positions, driven.normals, driven.groups, driven.mask, driven.advanced().positions


def driven_of(tensors: tuple[Tensor, Tensor, Tensor, Tensor, Tensor] | None) -> Driven | None:
    """Return what ``driven_tensors`` was made of."""
    if tensors is None:
        return None
    positions, normals, groups, mask, following = tensors
    return Driven(positions, normals, groups, mask, next_positions=following, next_normals=normals)
