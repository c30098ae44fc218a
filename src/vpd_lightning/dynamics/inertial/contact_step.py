"""What contact makes of a step: bodies, what stands still, and what is driven, in one solver."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, Inertia
from vpd_lightning.dynamics.inertial.contact import ContactSolver, Resolved
from vpd_lightning.dynamics.inertial.contact_points import between_bodies, pushed_surface
from vpd_lightning.dynamics.inertial.contact_search import ContactPoints, Contacts
from vpd_lightning.dynamics.inertial.driven_bodies import (
    DrivenBodies,
    driven_bodies,
    is_pushed,
    is_touched,
    joined_inertia,
    joined_materials,
    joined_motion,
    meet,
)
from vpd_lightning.dynamics.inertial.memory import InertialMemory
from vpd_lightning.dynamics.inertial.resting import rows_of
from vpd_lightning.dynamics.inertial.substeps import SubstepSolver
from vpd_lightning.types import Driven


def about_to_be_pushed(
    driven: Driven, positions: Float[Tensor, "batch moving 3"], memory: InertialMemory, *, is_mirrored: bool
) -> Bool[Tensor, " batch"]:
    """Return in which members what is driven comes near a body in this step."""
    surface = pushed_surface(positions, memory, is_mirrored)
    return is_pushed(driven_bodies(driven, memory.origin), surface, memory.motion)


@dataclass(frozen=True)
class BeforeContact:
    """A step as forces alone would make it, and what may touch something in it."""

    motion: BodyMotion
    inertia: Inertia
    points: ContactPoints
    contacts: Contacts  # with what stands still


def touched_by_driven(
    driven: Driven,
    step: BeforeContact,
    positions: Float[Tensor, "state moving 3"],
    memory: InertialMemory,
    place: Int64[Tensor, " batch"],
    *,
    is_mirrored: bool,
) -> Bool[Tensor, " batch"]:
    """Return which of several driven motions touch a body; ``place`` says from which of the states each starts."""
    surface = pushed_surface(positions, memory, is_mirrored)
    parts = rows_of((surface, step.motion, step.points, memory.origin), place, len(positions))
    return is_touched(driven_bodies(driven, parts[3]), *parts[:3])


def resolved_contacts(
    step: BeforeContact,
    memory: InertialMemory,
    positions: Float[Tensor, "batch moving 3"],
    driven: DrivenBodies | None,
    driven_friction: Float[Tensor, ""] | None,
    *,
    is_mirrored: bool,
    rest_speed: float,
    num_iterations: int,
    num_substeps: int | None,
    max_depth: float,
) -> Resolved:
    """Return the step after contact of bodies with what stands still, each other and what is driven.

    What is driven is left out of the result, and what is guided goes on as it came (``GuidanceNetwork``). With
    ``num_substeps`` it is resolved in so many parts (``SubstepSolver``), else at once in ``num_iterations``.
    """
    motion, inertia, points, contacts = step.motion, step.inertia, step.points, step.contacts
    before = memory.motion
    between, materials, masses = between_bodies(points, memory), memory.materials, memory.masses
    num_bodies, met = masses.shape[1], None
    if driven is not None:
        surface = pushed_surface(positions, memory, is_mirrored)
        met = meet(driven, surface, motion, points, contacts, between)
    if driven is not None and met is not None:
        assert driven_friction is not None
        points, contacts, between = met.points, met.static, met.between
        count = driven.members.shape[1]
        before = joined_motion(before, driven.motion)
        motion, inertia = joined_motion(motion, driven.motion), joined_inertia(inertia, count)
        materials = joined_materials(materials, driven_friction, count)
        # Ratios alone matter, and the square of a small body's volume is no float32.
        masses = masses / masses.detach().amax(dim=1, keepdim=True)
        masses = torch.cat([masses, torch.full_like(masses[:, :1], torch.inf).expand(-1, count, -1)], dim=1)
    kind = ContactSolver if num_substeps is None else SubstepSolver
    solver = kind(
        points=points,
        centers=motion.centers,
        inertia=inertia,
        materials=materials,
        masses=masses,
        rest_speed=rest_speed,
        num_driven=masses.shape[1] - num_bodies,
    )
    if isinstance(solver, SubstepSolver):
        assert num_substeps is not None
        resolved = solver.resolve_in_parts(
            before, motion, contacts, between, num_substeps=num_substeps, max_depth=max_depth
        )
    else:
        resolved = solver.resolve(motion, contacts, between, num_iterations=num_iterations, max_depth=max_depth)
    if met is not None:
        resolved = resolved.first(num_bodies)
    if memory.guided is not None:
        resolved = resolved.guided(memory.motion, memory.guided)
    if met is not None or driven_friction is None:
        return resolved
    # Nothing was touched: a gradient of zero all the same, because on several devices each weight must have one.
    displacements = resolved.step.displacements + 0 * driven_friction
    return replace(resolved, step=replace(resolved.step, displacements=displacements))
