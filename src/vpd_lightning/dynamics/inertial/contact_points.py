"""Which points of bodies may touch something in a step, and what of them another body or a driven part may push."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import vectors_of
from vpd_lightning.dynamics.inertial.contact_search import BodyContacts, ContactPoints, nearest_body_contacts
from vpd_lightning.dynamics.inertial.driven_bodies import Surface
from vpd_lightning.dynamics.inertial.memory import InertialMemory

_PAIR_REACH = 1.5
"""Spacings beside the nearest particle of another body within which that still locates its surface."""


def contact_points(
    positions: Float[Tensor, "batch probe 3"],
    memory: InertialMemory,
    members: Float[Tensor, "batch body probe"],
    is_mirrored: bool,
) -> ContactPoints:
    """Return what may touch: the probes and, where their hidden sides are to be guessed, their mirror images.

    Cameras above a body do not see what it will land on. Most bodies are alike on both sides of their centre.
    """
    count = positions.shape[1]
    normals = memory.normals[:, :count]
    if not is_mirrored:
        return ContactPoints(positions, normals, members)
    centers = vectors_of(memory.motion.centers, memory.own[:, :count])
    mirrored = members * memory.mirrored[:, None, :count]
    return ContactPoints(
        torch.cat([positions, 2 * centers - positions], dim=1),
        torch.cat([normals, -normals], dim=1),
        torch.cat([members, mirrored.to(members.dtype)], dim=2),
    )


def between_bodies(points: ContactPoints, memory: InertialMemory) -> BodyContacts | None:
    """Return where bodies may touch each other; None where there is nothing to touch, which saves the work."""
    if points.members.shape[1] == 1:
        return None
    # No deeper than a third of a body: what lies deeper came from the other side.
    depth = (points.members * body_sizes(memory)[..., None]).sum(dim=1) / 3
    found = nearest_body_contacts(points, _PAIR_REACH * memory.spacing, depth)
    return found if bool(found.known.any()) else None


def pushed_surface(positions: Float[Tensor, "batch moving 3"], memory: InertialMemory, is_mirrored: bool) -> Surface:
    """Return all that may be pushed: the particles of bodies and, where they are guessed, their mirror images."""
    centers = vectors_of(memory.motion.centers, memory.own)
    facing = memory.mask & (memory.normals.square().sum(dim=-1) > 0.5)
    sizes = body_sizes(memory)
    lengths = (positions - centers).detach().square().sum(dim=-1) * facing
    radii = torch.zeros_like(sizes).scatter_reduce(1, memory.own, lengths, "amax").sqrt()
    parts = [(positions, memory.normals, memory.own, facing)]
    if is_mirrored:
        parts.append((2 * centers - positions, -memory.normals, memory.own, facing & memory.mirrored))
    places, normals, own, usable = (torch.cat(each, dim=1) for each in zip(*parts, strict=True))
    return Surface(places, normals, own, usable, memory.spacing, sizes, radii)


def body_sizes(memory: InertialMemory) -> Float[Tensor, "batch body"]:
    """Return the root mean square radius of each body (metres)."""
    return ((memory.masses / memory.materials.density).detach().clamp(min=1e-27) ** (1 / 3)).squeeze(-1)
