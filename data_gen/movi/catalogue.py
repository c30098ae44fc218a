"""What can be thrown: named shapes, textured stand-ins for scans, or the user's meshes, each ready to be scaled."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from data_gen.movi.collision_parts import CollisionPart, hull
from data_gen.movi.inertia import solid_of
from data_gen.movi.mesh import Mesh
from data_gen.movi.settings import ObjectSettings
from data_gen.movi.shapes import collision_parts, shape_mesh

# These are drawn by MuJoCo as what collides, the others as meshes. Volume and inertia of the true round ones, whose
# longest side is 1: pi r^2 h and m (3 r^2 + h^2) / 12, m r^2 / 2 about the axis; 4 pi r^3 / 3 and 2 m r^2 / 5.
PRIMITIVES = ("cube", "sphere", "cylinder")
_ROUND_SOLIDS = {
    "cylinder": (np.pi / 4, np.pi / 4 * np.diag([1.75 / 12, 1.75 / 12, 0.125])),
    "sphere": (np.pi / 6, np.pi / 6 * 0.1 * np.eye(3)),
}
_NUM_CACHED = 64


@dataclass(frozen=True, eq=False)
class Item:
    """An object whose longest side is 1 m and whose centre of mass is the origin."""

    name: str
    mesh: Mesh
    parts: tuple[CollisionPart, ...]
    volume: float
    inertia: NDArray[np.float64]  # (3, 3) about the centre of mass at density 1
    is_primitive: bool

    def scaled(self, size: float) -> "Item":
        """Return the object with a longest side of ``size`` metres."""
        return dataclasses.replace(
            self,
            mesh=self.mesh.scaled(size),
            parts=tuple(part.scaled(size) for part in self.parts),
            volume=self.volume * size**3,
            inertia=self.inertia * size**5,
        )

    @property
    def half_sizes(self) -> NDArray[np.float64]:
        """(3,): half sides of the smallest box around the centre of mass that holds the object."""
        return np.abs(self.mesh.vertices).max(axis=0)


class Catalogue:
    """Everything that the settings allow to be thrown; draws are equally likely."""

    def __init__(self, settings: ObjectSettings) -> None:
        self.shapes = tuple(settings.shapes)
        self.user_meshes: Sequence[tuple[str, Mesh]] = ()
        if settings.mesh_folder is not None:
            from data_gen.movi.user_meshes import load_folder

            self.user_meshes = load_folder(settings.mesh_folder)

    def draw(self, generator: np.random.Generator) -> Item:
        """Return a random object."""
        if self.shapes:
            return _named(self.shapes[int(generator.integers(len(self.shapes)))])
        if self.user_meshes:
            name, mesh = self.user_meshes[int(generator.integers(len(self.user_meshes)))]
            return _scan(name.replace(",", "_"), mesh)  # names are listed with commas between them
        from data_gen.movi.stand_ins import NUM_STAND_INS

        return _stand_in(int(generator.integers(NUM_STAND_INS)))


@cache
def _named(name: str) -> Item:
    return _item(name, shape_mesh(name), collision_parts(name), shape_mesh(name))


@lru_cache(maxsize=_NUM_CACHED)
def _stand_in(index: int) -> Item:
    from data_gen.movi.stand_ins import family, stand_in

    return _scan(f"{family(index)}_{index:04d}", stand_in(index))


def _scan(name: str, mesh: Mesh) -> Item:
    """Scans, true or not, collide as their convex hull; open ones also weigh what it weighs."""
    mesh = mesh.normalized()
    part = hull(mesh.vertices)
    assert part.mesh is not None
    is_solid = mesh.is_closed and mesh.volume > 0.02 * part.mesh.volume
    return _item(name, mesh, (part,), mesh if is_solid else part.mesh)


def _item(name: str, mesh: Mesh, parts: Sequence[CollisionPart], solid: Mesh) -> Item:
    volume, center, inertia = solid_of(solid)
    volume, inertia = _ROUND_SOLIDS.get(name, (volume, inertia))
    return Item(
        name=name,
        mesh=dataclasses.replace(mesh, vertices=mesh.vertices - center),
        parts=tuple(dataclasses.replace(part, position=part.position - center) for part in parts),
        volume=volume,
        inertia=inertia,
        is_primitive=name in PRIMITIVES,
    )
