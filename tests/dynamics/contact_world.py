"""A small world of bodies with known masses on a floor, moved by the contact solver alone. Metres and steps."""

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion, body_inertia, vectors_of
from vpd_lightning.dynamics.inertial.contact import ContactSolver, Resolved
from vpd_lightning.dynamics.inertial.contact_search import ContactPoints, Contacts, nearest_body_contacts
from vpd_lightning.dynamics.inertial.materials import Materials, elastic
from vpd_lightning.dynamics.inertial.rigid_motion import rotate, rotation_from_spin

FAR = 10.0


def floor_contacts(positions: Tensor) -> Contacts:
    """Contacts of points (``batch point 3``) with the floor z = 0."""
    up = positions.new_tensor([0.0, 0.0, 1.0]).expand_as(positions)
    return Contacts(positions[..., 2].clone(), up, torch.zeros_like(positions[..., 2]))


def nothing_near(positions: Tensor) -> Contacts:
    far = torch.full_like(positions[..., 2], FAR)
    return Contacts(far, torch.zeros_like(positions), far)


@dataclass
class World:
    """Bodies (points and normals about their own centres) at places; ``bodies`` may hold more places than bodies."""

    shapes: list[tuple[Tensor, Tensor]]
    places: list[tuple[float, float, float]]
    velocities: list[tuple[float, float, float]]
    spins: list[tuple[float, float, float]] | None = None
    masses: list[float] | None = None
    gravity: float = 0.0  # metres per step squared
    friction: float = 0.0
    restitution: float = 0.0
    softness: float = 0.0
    stiffness: float = 0.25
    damping: float = 0.1
    rest_speed: float = 1e-9
    num_iterations: int = 4
    has_floor: bool = True
    num_empty: int = 0
    reach: float = 0.05
    dtype: torch.dtype = torch.float64
    motion: BodyMotion = field(init=False)
    last: Resolved = field(init=False)

    def __post_init__(self) -> None:
        count = len(self.shapes) + self.num_empty
        as_rows = {"dtype": self.dtype}
        places = torch.zeros(1, count, 3, **as_rows)
        places[0, : len(self.shapes)] = torch.tensor(self.places, **as_rows)
        velocities, spins = torch.zeros_like(places), torch.zeros_like(places)
        velocities[0, : len(self.shapes)] = torch.tensor(self.velocities, **as_rows)
        if self.spins is not None:
            spins[0, : len(self.shapes)] = torch.tensor(self.spins, **as_rows)
        eye = torch.eye(3, **as_rows).expand(1, count, 3, 3)
        self.motion = BodyMotion(places, velocities, spins, eye, torch.zeros_like(eye))
        pairs = zip(self.shapes, self.places, strict=True)
        self.positions = torch.cat([shape[0].to(self.dtype) + places.new_tensor(at) for shape, at in pairs])[None]
        self.normals = torch.cat([shape[1].to(self.dtype) for shape in self.shapes])[None]
        owner = torch.cat([torch.full((len(shape[0]),), body) for body, shape in enumerate(self.shapes)])
        self.members = (owner == torch.arange(count)[:, None]).to(self.dtype)[None]
        masses = torch.ones(1, count, 1, **as_rows)
        if self.masses is not None:
            masses[0, : len(self.shapes), 0] = torch.tensor(self.masses, **as_rows)
        self.mass = masses

        def same(value: float) -> Tensor:
            return torch.full((1, count, 1), value, **as_rows)

        self.materials = Materials(
            same(self.friction), same(self.restitution), same(1.0), same(self.softness), same(self.stiffness),
            same(self.damping),
        )  # fmt: skip

    def inertia(self):
        shares = self.members / self.members.sum(dim=-1, keepdim=True).clamp(min=1)
        one = torch.ones((), dtype=self.dtype)
        return body_inertia(self.positions, self.motion.centers, shares, self.materials.softness, one)

    def resolve(self) -> Resolved:
        """Return this step after weight, elastic return and contact."""
        weight = self.positions.new_tensor([0.0, 0.0, -self.gravity])
        free = replace(self.motion, displacements=self.motion.displacements + weight)
        free = replace(free, strains=elastic(free, self.materials))
        points = ContactPoints(self.positions, self.normals, self.members)
        static = floor_contacts(self.positions) if self.has_floor else nothing_near(self.positions)
        between = None
        if self.members.shape[1] > 1:
            reach = self.positions.new_full((1,), self.reach)
            between = nearest_body_contacts(points, reach, torch.full_like(self.positions[..., 0], 0.1))
        solver = ContactSolver(
            points=points,
            centers=self.motion.centers,
            inertia=self.inertia(),
            materials=self.materials,
            masses=self.mass,
            rest_speed=self.rest_speed,
        )
        return solver.resolve(free, static, between, num_iterations=self.num_iterations, max_depth=0.1)

    def step(self) -> None:
        self.last = self.resolve()
        step, onward = self.last.step, self.last.onward
        own = self.members.argmax(dim=1)
        offsets = self.positions - vectors_of(step.centers, own)
        self.positions = vectors_of(step.centers + step.displacements, own) + step.turned(offsets, own)
        turned = rotate(rotation_from_spin(step.spins)[:, :, None], self.normals[:, None])
        self.normals = (self.members[..., None] * turned).sum(dim=1)
        stretches, _ = step.following_stretches()
        _, strains = onward.following_stretches()
        self.motion = BodyMotion(
            step.centers + step.displacements, onward.displacements, onward.spins, stretches, strains
        )

    def velocity(self, body: int = 0) -> Tensor:
        return self.motion.displacements[0, body]

    def center(self, body: int = 0) -> Tensor:
        return self.motion.centers[0, body]
