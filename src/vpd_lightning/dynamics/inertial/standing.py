"""What bodies stand on when they are first seen: surfaces with edges, also where hidden, and who rests there."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.dynamics.inertial.contact_points import body_sizes, contact_points
from vpd_lightning.dynamics.inertial.contact_search import nearest_static_contacts
from vpd_lightning.dynamics.inertial.memory import InertialMemory
from vpd_lightning.dynamics.inertial.resting import is_slow
from vpd_lightning.dynamics.inertial.round_bodies import rolling, touches, with_feet
from vpd_lightning.dynamics.inertial.static_surface import resting_clearances, static_surface
from vpd_lightning.types import Driven


def standing(
    memory: InertialMemory,
    positions: Float[Tensor, "batch moving 3"],
    statics: tuple[Tensor, Tensor, Tensor],
    driven: Driven | None,
    *,
    num_probes: int,
    is_mirrored: bool,
    supported_speed: float,
    rest_speed: float,
    arm: float,
    edge_reach: float | None,
    workspace: tuple[Sequence[float], Sequence[float]] | None,
    far: float,
) -> InertialMemory:
    """Return the memory with what of the static surface is hidden, where it ends, and which bodies rest on it.

    ``positions`` are those of the moving candidates and ``statics`` positions, normals and mask of what stands still,
    from the memory's origin; lengths in metres, speeds in metres per step. ``arm`` is at which a spin counts.
    ``workspace`` is its lowest and highest corner in the world.
    """
    above, is_above = positions.detach(), memory.mask
    if driven is not None:
        above = torch.cat([above, driven.positions - memory.origin], dim=1)
        is_above = torch.cat([is_above, driven.mask], dim=1)
    clearances = memory.surface.clearances
    if supported_speed > 0:
        probes, members = positions[:, :num_probes], memory.bodies[:, :, :num_probes]
        # Mirror images that would lie in the surface count as well: they say how wide the foot is.
        points = contact_points(probes, replace(memory, mirrored=memory.mask), members, is_mirrored)
        points = with_feet(points, memory.shapes, memory.motion, statics, None, clearances, far)
        sizes = body_sizes(memory)
        clearances, rests = resting_clearances(points, statics, memory.motion, sizes, supported_speed, far)
        undisturbed = rests & is_slow(memory.motion, rest_speed, arm)
        is_held = torch.zeros_like(rests)
        if driven is not None:
            places = driven.positions - memory.origin
            is_held = touches(memory.shapes, memory.motion.centers, places, driven.mask)
        memory = replace(memory, motion=rolling(memory.motion, points.feet, is_held))
        memory = replace(
            memory,
            mirrored=memory.mask & (memory.mirrored | torch.gather(rests, 1, memory.own)),
            undisturbed=undisturbed,
            at_rest=memory.at_rest | undisturbed,
        )
    walls = None
    if workspace is not None:
        low, high = (memory.origin.new_tensor(list(corner)) - memory.origin for corner in workspace)
        walls = low, high
    return replace(memory, surface=static_surface(statics, above, is_above, edge_reach, clearances, walls))


def may_be_hidden(
    statics: tuple[Tensor, Tensor, Tensor],
    positions: Float[Tensor, "batch moving 3"],
    bodies: Float[Tensor, "batch body moving"],
    centers: Float[Tensor, "batch body 3"],
    far: float,
) -> Bool[Tensor, "batch moving"]:
    """Return whose mirror image through the centre does not lie inside what stands still: nothing can be there."""
    mirrored = 2 * (bodies[..., None] * centers[:, :, None]).sum(dim=1) - positions
    return nearest_static_contacts(mirrored, *statics, far).distances > 0
