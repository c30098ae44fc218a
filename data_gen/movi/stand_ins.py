"""Stand-ins for the 1,033 scanned objects of MOVi-C: as many closed textured meshes, each made from its number alone.

Google's scans are not shipped here, so these are not they: no scanned detail, no printed brands. They have what a
learner meets in the scans: shoes, packages, vessels, animals, smooth and lumpy bodies in many colours and patterns.
Where the scans are at hand, ``user_meshes`` takes them instead.
"""

from collections.abc import Callable

import numpy as np

from data_gen.movi import bodies
from data_gen.movi.mesh import Mesh
from data_gen.movi.textures import object_texture, package_texture

NUM_STAND_INS = 1033
_CODE = 0x57A4D  # sets these random numbers apart from all others

# Family, its share, and the edges (degrees) from which it is shaded as an edge.
_Family = tuple[Callable[[np.random.Generator], Mesh], float, float]
_FAMILIES: dict[str, _Family] = {
    "shoe": (bodies.shoe, 0.2, 50.0),
    "package": (bodies.package, 0.2, 50.0),
    "bottle": (bodies.bottle, 0.12, 50.0),
    "bowl": (bodies.bowl, 0.07, 60.0),
    "mug": (bodies.mug, 0.07, 60.0),
    "animal": (bodies.animal, 0.18, 180.0),
    "superquadric": (bodies.superquadric, 0.09, 40.0),
    "lump": (bodies.lump, 0.07, 180.0),
}
FAMILIES = tuple(_FAMILIES)


def family(index: int) -> str:
    """Return the family of stand-in ``index``."""
    _check(index)
    shares = np.array([share for _, share, _ in _FAMILIES.values()])
    return FAMILIES[int(_generator(index).choice(len(FAMILIES), p=shares / shares.sum()))]


def stand_in(index: int) -> Mesh:
    """Return stand-in ``index`` (0 to ``NUM_STAND_INS`` - 1): textured, closed, centred, longest side 1, z up.

    The same bytes each time. What collides is its convex hull (``collision_parts.hull``).
    """
    name = family(index)
    make, _, crease = _FAMILIES[name]
    generator = np.random.default_rng([_CODE, index, 1])
    mesh = make(generator).normalized().shaded(crease)
    paint = package_texture if name == "package" else object_texture
    return Mesh(mesh.vertices, mesh.faces, mesh.texcoords, paint(generator), mesh.normals)


def _generator(index: int) -> np.random.Generator:
    return np.random.default_rng([_CODE, index])


def _check(index: int) -> None:
    if not 0 <= index < NUM_STAND_INS:
        raise ValueError(f"there is no stand-in {index}; they are numbered 0 to {NUM_STAND_INS - 1}")
