"""What the inertial dynamics carries from step to step."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion
from vpd_lightning.dynamics.inertial.hidden_side import HiddenParticles
from vpd_lightning.dynamics.inertial.materials import Materials
from vpd_lightning.dynamics.inertial.static_surface import StaticSurface


@dataclass(frozen=True)
class InertialMemory:
    """What the inertial dynamics carries from step to step; gathered over the particles that may move."""

    origin: Float[Tensor, "batch 1 3"]  # metres, world; origin of all other positions
    index: Int[Tensor, "batch moving"]  # slots of the moving candidates among all particles
    mask: Bool[Tensor, "batch moving"]
    bodies: Float[Tensor, "batch body moving"]  # 1 where a particle belongs to a body, else 0
    own: Int[Tensor, "batch moving"]  # the number of that body; 0 for padding
    motion: BodyMotion  # the velocity with which bodies go into the next step
    materials: Materials
    masses: Float[Tensor, "batch body 1"]
    guided: Float[Tensor, "batch body 1"] | None  # share of its motion that goes on whatever acts on it
    spacing: Float[Tensor, " batch"]  # of the moving candidates (metres)
    normals: Float[Tensor, "batch moving 3"]
    velocities: Float[Tensor, "batch moving 3"]  # metres a step; used with keep_shape=false only
    mirrored: Bool[Tensor, "batch moving"]  # true if its mirror image may lie on the hidden side
    first_features: Float[Tensor, "batch moving feature"]
    first_shade: Float[Tensor, "batch moving feature"]
    static_index: Int[Tensor, "batch static"]
    static_normals: Float[Tensor, "batch static 3"]  # zero where they are not trusted
    static_mask: Bool[Tensor, "batch static"]
    static_features: Float[Tensor, "batch static feature"]
    static_shade: Float[Tensor, "batch static feature"]  # with the moving ones where they were at first
    hidden: HiddenParticles | None
    surface: StaticSurface
    undisturbed: Bool[Tensor, "batch body"]  # it was seen to stand still, and nothing has pushed it since
    shapes: Float[Tensor, "batch body 3 3"]  # of ellipsoids (square metres, ``round_bodies``), 0 of other bodies
    at_rest: Bool[Tensor, "batch body"]  # it stands or lies and hardly moves; a place without a body does, too
    past: Int[Tensor, " batch"]  # equal numbers: members that were one, and have met nothing driven since
