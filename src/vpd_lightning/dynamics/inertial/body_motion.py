"""How bodies move in one step: shift, turn and stretch, and what a push at a point does to all three."""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vpd_lightning.dynamics.inertial.rigid_motion import cross, rotate, rotation_from_spin

MAX_STRAIN = 0.6
"""Frobenius norm of stretch minus identity that a body nears and never passes: a stretch must keep its inverse."""


@dataclass(frozen=True)
class BodyMotion:
    """Motion of each body over one step.

    A point at an offset from the centre goes to centre + displacement + rotation(spin) (stretch + strain) stretch^-1
    offset. ``spins`` are 2 tan(angle / 2) * axis; ``strains`` are the change of the symmetric ``stretches``
    (dimensionless, world axes; identity is the shape that the body was seen in). Rigid bodies keep identity and
    zero exactly.
    """

    centers: Float[Tensor, "batch body 3"]
    displacements: Float[Tensor, "batch body 3"]
    spins: Float[Tensor, "batch body 3"]
    stretches: Float[Tensor, "batch body 3 3"]
    strains: Float[Tensor, "batch body 3 3"]

    def pushed(self, change: "Push") -> "BodyMotion":
        """Return the motion after the change of velocities that a push makes."""
        return replace(
            self,
            displacements=self.displacements + change.displacements,
            spins=self.spins + change.spins,
            strains=self.strains + change.strains,
        )

    def towards(self, other: "BodyMotion", share: Float[Tensor, "batch body 1"]) -> "BodyMotion":
        """Return this motion with so much of another."""
        return replace(
            self,
            displacements=torch.lerp(self.displacements, other.displacements, share),
            spins=torch.lerp(self.spins, other.spins, share),
            strains=torch.lerp(self.strains, other.strains, share[..., None]),
        )

    def first(self, count: int) -> "BodyMotion":
        """Return the motion of the first bodies."""
        return BodyMotion(*(getattr(self, item.name)[:, :count] for item in fields(self)))

    def deformation(self) -> Float[Tensor, "batch body 3 3"]:
        """Return (stretch + strain) stretch^-1, identity for a rigid body."""
        return torch.linalg.solve(self.stretches.mT, (self.stretches + self.limited_strains()).mT).mT

    def limited_strains(self) -> Float[Tensor, "batch body 3 3"]:
        """Return the strains, shortened where the new stretch would pass ``MAX_STRAIN``."""
        eye = torch.eye(3, dtype=self.strains.dtype, device=self.strains.device)
        off = self.stretches + self.strains - eye
        norm = off.square().sum(dim=(-2, -1), keepdim=True)
        # Above half the limit it saturates; below, nothing changes.
        excess = torch.relu(norm.clamp(min=1e-18).sqrt() - MAX_STRAIN / 2)
        length = MAX_STRAIN / 2 + MAX_STRAIN / 2 * torch.tanh(excess / (MAX_STRAIN / 2))
        share = torch.where(excess > 0, length / norm.clamp(min=1e-18).sqrt(), 1.0)
        return eye + share * off - self.stretches

    def turned(
        self, offsets: Float[Tensor, "batch point 3"], bodies: Int[Tensor, "batch point"]
    ) -> Float[Tensor, "batch point 3"]:
        """Return where offsets of points from the centres of their bodies point after the step."""
        return rotate(matrices_of(rotation_from_spin(self.spins) @ self.deformation(), bodies), offsets)

    def carried(
        self, positions: Float[Tensor, "batch point 3"], bodies: Int[Tensor, "batch point"]
    ) -> Float[Tensor, "batch point 3"]:
        """Return where points of bodies are after the step (metres)."""
        offsets = positions - vectors_of(self.centers, bodies)
        return vectors_of(self.centers + self.displacements, bodies) + self.turned(offsets, bodies)

    def following_stretches(self) -> tuple[Tensor, Tensor]:
        """Return stretch and strain after the step, turned with the body."""
        rotation = rotation_from_spin(self.spins)
        strains = self.limited_strains()
        return tuple(rotation @ matrix @ rotation.mT for matrix in (self.stretches + strains, strains))  # type: ignore[return-value]


@dataclass(frozen=True)
class Push:
    """Change of a motion by pushes (metres per step, radians per step, dimensionless)."""

    displacements: Float[Tensor, "batch body 3"]
    spins: Float[Tensor, "batch body 3"]
    strains: Float[Tensor, "batch body 3 3"]


@dataclass(frozen=True)
class Inertia:
    """What resists a push, per unit of mass: turning and stretching.

    ``inverse_moments`` is the inverse of the second moment J of the mass about the centre; ``softness`` (0 for a rigid
    body) how readily it stretches. A push p at the arm a changes the displacement by p, the spin by I^-1 (a x p) with
    I = tr(J) - J, and, as in affine body dynamics (Lan et al. 2022), the stretch by the symmetric part of p (J^-1 a)^T,
    times softness.
    """

    inverse_turning: Float[Tensor, "batch body 3 3"]
    inverse_moments: Float[Tensor, "batch body 3 3"]
    softness: Float[Tensor, "batch body 1"]

    def push(self, arms: Float[Tensor, "batch body 3"], pushes: Float[Tensor, "batch body 3"]) -> Push:
        """Return what pushes (metres per step, at one point of each body) do to its motion."""
        turn = rotate(self.inverse_turning, cross(arms, pushes))
        outer = pushes[..., :, None] * rotate(self.inverse_moments, arms)[..., None, :]
        return Push(pushes, turn, self.softness[..., None] * (outer + outer.mT) / 2)

    def response(self, arms: Tensor, directions: Tensor) -> Float[Tensor, "batch body 1"]:
        """Return how far the point at the arm moves along a unit direction for a unit push along it, at least 1."""
        lever = cross(arms, directions)
        turning = (lever * rotate(self.inverse_turning, lever)).sum(dim=-1, keepdim=True)
        spread = rotate(self.inverse_moments, arms)
        stretching = (arms * spread).sum(dim=-1, keepdim=True)
        stretching = stretching + ((directions * arms).sum(-1) * (directions * spread).sum(-1))[..., None]
        return 1 + turning + self.softness * stretching.clamp(min=0) / 2

    def gathered(self, index: Tensor) -> "Inertia":
        """Return the inertia of other bodies: ``index`` (``batch any``) counts bodies."""

        def take(values: Tensor) -> Tensor:
            flat = index.reshape(*index.shape, *[1] * (values.dim() - 2)).expand(*index.shape, *values.shape[2:])
            return torch.gather(values, 1, flat)

        return Inertia(take(self.inverse_turning), take(self.inverse_moments), take(self.softness))


def vectors_of(
    values: Float[Tensor, "batch body channel"], bodies: Int[Tensor, "batch point"]
) -> Float[Tensor, "batch point channel"]:
    """Return for each point the value of its body."""
    return torch.gather(values, 1, bodies[..., None].expand(-1, -1, values.shape[-1]))


def matrices_of(
    values: Float[Tensor, "batch body 3 3"], bodies: Int[Tensor, "batch point"]
) -> Float[Tensor, "batch point 3 3"]:
    """Return for each point the matrix of its body."""
    return torch.gather(values, 1, bodies[..., None, None].expand(-1, -1, 3, 3))


def body_inertia(
    positions: Float[Tensor, "batch particle 3"],
    centers: Float[Tensor, "batch body 3"],
    weights: Float[Tensor, "batch body particle"],
    softness: Float[Tensor, "batch body 1"],
    inertia_ratio: Float[Tensor, ""],
) -> Inertia:
    """Return the inertia of unit masses spread over the particles by ``weights`` (rows sum to one, or are zero).

    Mass inside a body is not where its surface particles are: ``inertia_ratio`` multiplies the inverse.
    """
    offsets = positions[:, None] - centers[:, :, None]
    moments = torch.einsum("bkp,bkpi,bkpj->bkij", weights, offsets, offsets)
    eye = torch.eye(3, dtype=moments.dtype, device=moments.device)
    trace = moments.diagonal(dim1=-2, dim2=-1).sum(dim=-1)[..., None, None]
    # The ridge keeps a flat or single-point body solvable; it is small against any body of more than a centimetre, and
    # a body of which one flat side is seen is not taken to be endlessly thin.
    moments = moments + (0.02 * trace + 1e-6) * eye
    trace = moments.diagonal(dim1=-2, dim2=-1).sum(dim=-1)[..., None, None]
    return Inertia(
        inverse_turning=torch.linalg.inv(trace * eye - moments) * inertia_ratio,
        inverse_moments=torch.linalg.inv(moments) * inertia_ratio,
        softness=softness,
    )


def body_volumes(positions: Tensor, centers: Tensor, shares: Tensor) -> Float[Tensor, "batch body 1"]:
    """Return the cube of each body's root mean square radius, to which its volume is in proportion (cubic metres).

    A place without a body gets 1: masses are divided by.
    """
    offsets = positions[:, None] - centers[:, :, None]
    square = (shares * offsets.square().sum(dim=-1)).sum(dim=-1, keepdim=True)
    there = shares.sum(dim=-1, keepdim=True) > 0
    return torch.where(there, square.clamp(min=1e-18), 1.0) ** 1.5
