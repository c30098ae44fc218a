"""Volume, centre of mass and inertia of the solid inside a closed triangle mesh."""

import numpy as np
from numpy.typing import NDArray

from data_gen.movi.mesh import Mesh


def solid_of(mesh: Mesh) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Return volume, centre of mass (3,) and inertia (3, 3) about that centre at density 1, in the mesh's axes.

    Sums the tetrahedra that the faces make with a point (divergence theorem); exact for a closed mesh.
    """
    middle = mesh.bounds.mean(axis=0)
    corners = np.moveaxis(mesh.corners, 0, 1) - middle
    volumes = np.linalg.det(corners) / 6.0
    volume = float(volumes.sum())
    centers = corners.sum(axis=1) / 4.0
    center = volumes @ centers / volume
    # Second moments of a tetrahedron with corners a, b, c and the origin: V / 20 (aa + bb + cc + ss), s = a + b + c.
    sums = corners.sum(axis=1)
    second = np.einsum("n,nki,nkj->ij", volumes, corners, corners) + np.einsum("n,ni,nj->ij", volumes, sums, sums)
    second = second / 20.0 - volume * np.outer(center, center)
    return volume, middle + center, np.trace(second) * np.eye(3) - second
