"""Triangle meshes as the MOVi-like scenes use them: measured, placed, and shaded with creases."""

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in the units of its owner (1 = the longest side where a shape is "normalised").

    Attributes:
        vertices: (vertex, 3) float64.
        faces: (face, 3) int32, counter-clockwise seen from outside.
        texcoords: (vertex, 2) or None; u to the right and v *up* the picture, 0 to 1 (others repeat). A vertex on a
            seam stands there once for each side.
        texture: (height, width, 3) sRGB uint8 or None; row 0 is the top (v = 1).
        normals: (vertex, 3) unit normals for shading or None (whoever draws averages over the faces).
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    texcoords: NDArray[np.float64] | None = None
    texture: NDArray[np.uint8] | None = None
    normals: NDArray[np.float64] | None = None

    @property
    def bounds(self) -> NDArray[np.float64]:
        """(2, 3): the smallest and the largest coordinates."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def extents(self) -> NDArray[np.float64]:
        """(3,): the sides of the bounding box."""
        return self.vertices.max(axis=0) - self.vertices.min(axis=0)

    def centered(self) -> "Mesh":
        """Move the middle of the bounding box to the origin."""
        return dataclasses.replace(self, vertices=self.vertices - self.bounds.mean(axis=0))

    def scaled(self, factor: float) -> "Mesh":
        """Scale about the origin."""
        return dataclasses.replace(self, vertices=self.vertices * factor)

    def normalized(self, longest: float = 1.0) -> "Mesh":
        """Centre the bounding box and give its longest side the length ``longest``."""
        return self.centered().scaled(longest / float(self.extents.max()))

    @cached_property
    def welded_faces(self) -> NDArray[np.int64]:
        """(face, 3): the faces by corner positions, without regard to seams; equal numbers are equal positions."""
        scale = max(float(np.abs(self.vertices).max()), 1e-30)
        _, index = np.unique(np.rint(self.vertices * (1e9 / scale)).astype(np.int64), axis=0, return_inverse=True)
        return np.asarray(index).reshape(-1)[self.faces]

    @property
    def is_closed(self) -> bool:
        """Whether each edge is walked as often in one direction as in the other: the surface has no border."""
        starts, ends = self.welded_faces.reshape(-1), np.roll(self.welded_faces, -1, axis=1).reshape(-1)
        count = int(self.welded_faces.max()) + 1
        forward, backward = np.sort(starts * count + ends), np.sort(ends * count + starts)
        return bool(np.array_equal(forward, backward))

    @property
    def volume(self) -> float:
        """Signed volume of a closed mesh: positive when its faces look outwards."""
        a, b, c = self.corners
        return float(np.einsum("ni,ni->", a, np.cross(b, c))) / 6.0

    @property
    def area(self) -> float:
        """Area of all faces."""
        return float(np.linalg.norm(self.face_vectors, axis=1).sum()) / 2.0

    @property
    def corners(self) -> NDArray[np.float64]:
        """(3, face, 3): the three corners of every face."""
        return np.moveaxis(self.vertices[self.faces], 1, 0)

    @property
    def face_vectors(self) -> NDArray[np.float64]:
        """(face, 3): outward normals as long as twice the face's area."""
        a, b, c = self.corners
        return np.cross(b - a, c - a)

    @property
    def corner_angles(self) -> NDArray[np.float64]:
        """(face, 3): the angle of each face at each of its corners, radians."""
        corners = np.moveaxis(self.corners, 0, 1)
        ahead = np.roll(corners, -1, axis=1) - corners
        behind = np.roll(corners, 1, axis=1) - corners
        across = np.linalg.norm(np.cross(ahead, behind), axis=-1)
        return np.asarray(np.arctan2(across, np.einsum("fki,fki->fk", ahead, behind)))

    def without_slivers(self) -> "Mesh":
        """Leave out faces two of whose corners are the same point (the poles of a grid); a closed mesh stays closed."""
        a, b, c = self.welded_faces.T
        return dataclasses.replace(self, faces=self.faces[(a != b) & (b != c) & (c != a)]).without_strays()

    def without_strays(self) -> "Mesh":
        """Leave out vertices that no face uses."""
        used, faces = np.unique(self.faces, return_inverse=True)
        return Mesh(
            vertices=self.vertices[used],
            faces=np.asarray(faces).reshape(-1, 3).astype(np.int32),
            texcoords=None if self.texcoords is None else self.texcoords[used],
            texture=self.texture,
            normals=None if self.normals is None else self.normals[used],
        )

    def shaded(self, crease: float = 40.0) -> "Mesh":
        """Give the mesh shading normals: smooth over seams, broken at edges sharper than ``crease`` (degrees).

        A corner's normal is the mean, weighted by their angles there, of the faces around its point that lie within
        ``crease`` of the corner's own face. Vertices are duplicated where their corners disagree. (Weights by area
        would show how quadrilaterals were cut into triangles.)
        """
        vectors = self.face_vectors
        units = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
        points = self.welded_faces.reshape(-1)
        weighted = (units[:, None] * self.corner_angles[..., None]).reshape(-1, 3)
        corner, neighbor = _pairs_at_same_point(points)
        face, other = corner // 3, neighbor // 3
        near = np.einsum("ni,ni->n", units[face], units[other]) >= np.cos(np.radians(crease)) - 1e-9
        normals = np.zeros((points.size, 3))
        for axis in range(3):
            normals[:, axis] = np.bincount(corner[near], weighted[neighbor[near], axis], minlength=points.size)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        old = self.faces.reshape(-1)
        keys = np.concatenate([old[:, None], np.rint(normals * 1e4).astype(np.int64)], axis=1)
        _, first, faces = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        return Mesh(
            vertices=self.vertices[old[first]],
            faces=np.asarray(faces).reshape(-1, 3).astype(np.int32),
            texcoords=None if self.texcoords is None else self.texcoords[old[first]],
            texture=self.texture,
            normals=normals[first],
        )


def join(meshes: list[Mesh]) -> Mesh:
    """Put meshes beside each other in one; texture coordinates are kept where all have them, normals are dropped."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    texcoords = [mesh.texcoords for mesh in meshes if mesh.texcoords is not None]
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]).astype(
            np.int32
        ),
        texcoords=np.concatenate(texcoords) if len(texcoords) == len(meshes) else None,
    )


def _pairs_at_same_point(points: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All ordered pairs (a corner with itself too) of face corners that lie on the same point."""
    order = np.argsort(points, kind="stable")
    counts = np.bincount(points)
    starts = np.cumsum(counts) - counts
    sizes = counts[points[order]]
    corner = np.repeat(order, sizes)
    within = np.arange(corner.size) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return corner, order[np.repeat(starts[points[order]], sizes) + within]
