"""What collides: primitives and convex meshes in an object's own frame."""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from data_gen.movi.mesh import Mesh

Kind = Literal["box", "sphere", "cylinder", "capsule", "mesh"]


def _origin() -> NDArray[np.float64]:
    return np.zeros(3)


def _identity() -> NDArray[np.float64]:
    return np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class CollisionPart:
    """One convex part of an object, in the object's frame and units.

    Attributes:
        kind: the geom type of MuJoCo.
        size: as MuJoCo wants it: box half sides; sphere radius; cylinder and capsule radius and half length (along
            their z, a capsule's without its caps); empty for a mesh.
        position: (3,) centre of the part (the origin of ``mesh``).
        quaternion: (4,) w x y z, part to object.
        mesh: the convex mesh of kind ``mesh``.
    """

    kind: Kind
    size: tuple[float, ...] = ()
    position: NDArray[np.float64] = field(default_factory=_origin)
    quaternion: NDArray[np.float64] = field(default_factory=_identity)
    mesh: Mesh | None = None

    def scaled(self, factor: float) -> "CollisionPart":
        """Scale about the object's origin."""
        return replace(
            self,
            size=tuple(value * factor for value in self.size),
            position=self.position * factor,
            mesh=None if self.mesh is None else self.mesh.scaled(factor),
        )

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance (negative inside) of points (..., 3) in the object's frame; a mesh's is a lower bound."""
        local = (points - self.position) @ rotation_matrix(self.quaternion)
        if self.kind == "mesh":
            assert self.mesh is not None
            a, _, _ = self.mesh.corners
            normals = self.mesh.face_vectors
            normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
            return np.asarray((local @ normals.T - np.einsum("ni,ni->n", a, normals)).max(axis=-1))
        if self.kind == "sphere":
            return np.asarray(np.linalg.norm(local, axis=-1) - self.size[0])
        if self.kind == "capsule":
            along = np.clip(local[..., 2], -self.size[1], self.size[1])
            return np.asarray(np.hypot(np.hypot(local[..., 0], local[..., 1]), local[..., 2] - along) - self.size[0])
        if self.kind == "cylinder":
            radial = np.hypot(local[..., 0], local[..., 1]) - self.size[0]
            excess = np.stack([radial, np.abs(local[..., 2]) - self.size[1]], axis=-1)
        else:
            excess = np.abs(local) - np.asarray(self.size)
        return np.asarray(np.linalg.norm(np.maximum(excess, 0.0), axis=-1) + np.minimum(excess.max(axis=-1), 0.0))


def capsule(start: NDArray[np.float64], end: NDArray[np.float64], radius: float) -> CollisionPart:
    """Return the capsule of ``radius`` around the segment from ``start`` to ``end``."""
    along = np.asarray(end, dtype=np.float64) - start
    length = float(np.linalg.norm(along))
    return CollisionPart("capsule", (radius, length / 2), (np.asarray(start) + end) / 2, _turn_z_to(along / length))


def hull(points: NDArray[np.float64]) -> CollisionPart:
    """Return the convex hull of points (point, 3) as one part.

    Raises:
        ValueError: the points lie in one plane, or are fewer than four.
    """
    # Imported here, because settings are read where nothing is built.
    from scipy.spatial import ConvexHull, QhullError

    try:
        found = ConvexHull(points)
    except (QhullError, ValueError) as error:
        raise ValueError("the points span no volume") from error
    faces = found.simplices.astype(np.int32)
    mesh = Mesh(np.asarray(points, dtype=np.float64), faces)
    inwards = np.einsum("ni,ni->n", mesh.face_vectors, found.equations[:, :3]) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return CollisionPart("mesh", mesh=Mesh(mesh.vertices, faces).without_strays())


def rotation_matrix(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) rotation of a unit quaternion w x y z."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _turn_z_to(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternion of the shortest rotation from +z to a unit direction."""
    x, y, z = direction
    if z < -1 + 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    quaternion = np.array([1 + z, -y, x, 0.0])
    return quaternion / np.linalg.norm(quaternion)
