"""The ground truth of soft bodies, noted frame by frame: all vertices, and the rigid motion that fits them best."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_gen.deformable.tetrahedra import TetrahedralMesh
from vpd_lightning.data import schema

Array = NDArray[np.float64]


class SimulationFailedError(Exception):
    """The simulation left what is plausible; never shown to users."""


class SoftBodies:
    """Notes the vertices of a model made by ``model.build_model``; a body's own frame is that of its mesh."""

    def __init__(
        self, data: Any, meshes: Sequence[TetrahedralMesh], masses: Sequence[Array], num_frames: int, max_speed: float
    ) -> None:
        self.data, self.meshes, self.masses, self.max_speed = data, meshes, masses, max_speed
        counts = [len(mesh.vertices) for mesh in meshes]
        ends = np.cumsum(counts)
        self.parts = [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]
        self.rest = np.concatenate([mesh.vertices for mesh in meshes])
        self.objects = np.repeat(np.arange(len(meshes), dtype=np.int32), counts)
        self.tetrahedra = np.concatenate(
            [mesh.tetrahedra + part.start for mesh, part in zip(meshes, self.parts, strict=True)]
        ).astype(np.int32)
        self.vertices = np.empty((num_frames, len(self.rest), 3), np.float32)
        self.positions, self.linear, self.angular = (np.empty((num_frames, len(meshes), 3)) for _ in range(3))
        self.quaternions = np.empty((num_frames, len(meshes), 4))

    def place(self, vertices: Sequence[Array]) -> None:
        """Put the bodies' vertices where they are wanted, at rest."""
        self.data.qpos[:] = (np.concatenate(vertices) - self.rest).ravel()
        self.data.qvel[:] = 0.0

    def observe(self, frame: int) -> None:
        """Note the state that ``data`` holds as that of ``frame``.

        Raises:
            SimulationFailedError: a coordinate is not finite or a vertex is faster than ``max_speed``.
        """
        points = self.rest + self.data.qpos.reshape(-1, 3)
        velocities = self.data.qvel.reshape(-1, 3)
        with np.errstate(over="ignore", invalid="ignore"):
            speed = float(np.linalg.norm(velocities, axis=1).max())
        if not (np.isfinite(points).all() and speed <= self.max_speed):
            raise SimulationFailedError(f"frame {frame}: the fastest vertex has {speed:.3g} m/s")
        self.vertices[frame] = points
        for body, part in enumerate(self.parts):
            before = self.quaternions[frame - 1, body] if frame else np.array([1.0, 0.0, 0.0, 0.0])
            fit = fit_rigid_motion(self.rest[part], points[part], velocities[part], self.masses[body])
            self.positions[frame, body], quaternion, self.linear[frame, body], self.angular[frame, body] = fit
            # q and -q are the same rotation: keep to one side, so that quaternions change smoothly.
            self.quaternions[frame, body] = -quaternion if quaternion @ before < 0 else quaternion

    def state(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of ``state/``, except the segmentation."""
        # Around the centre of mass, which positions are; the duck's box is not centred there.
        rests = [self.rest[part] for part in self.parts]
        centers = [mass @ rest / mass.sum() for mass, rest in zip(self.masses, rests, strict=True)]
        half_sizes = np.stack([abs(rest - center).max(axis=0) for rest, center in zip(rests, centers, strict=True)])
        return {
            schema.STATE_POSITIONS: self.positions,
            schema.STATE_QUATERNIONS: self.quaternions,
            schema.STATE_LINEAR_VELOCITIES: self.linear,
            schema.STATE_ANGULAR_VELOCITIES: self.angular,
            schema.STATE_HALF_SIZES: half_sizes,
            schema.STATE_VERTICES: self.vertices,
            schema.STATE_VERTEX_OBJECTS: self.objects,
            schema.STATE_TETRAHEDRA: self.tetrahedra,
        }


def fit_rigid_motion(rest: Array, points: Array, velocities: Array, masses: Array) -> tuple[Array, Array, Array, Array]:
    """Return the rigid motion that is nearest to a deformed body in the mass-weighted squares of its vertices.

    Args:
        rest: vertices (vertex, 3) in the body's frame, m.
        points: the same vertices in the world, m.
        velocities: m/s, world.
        masses: (vertex,) kg.

    Returns:
        Centre of mass in the world (3,), quaternion body to world (4,) w x y z (Kabsch 1976), velocity of the centre
        (3,) m/s, and angular velocity (3,) rad/s in the world: the one with the body's angular momentum.
    """
    weights = masses / masses.sum()
    center, linear = weights @ points, weights @ velocities
    arms, motions = points - center, velocities - linear
    u, _, vt = np.linalg.svd((arms * weights[:, None]).T @ (rest - weights @ rest))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    quaternion = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    inertia = (weights * (arms**2).sum(axis=1)).sum() * np.eye(3) - (arms * weights[:, None]).T @ arms
    angular = np.linalg.solve(inertia, weights @ np.cross(arms, motions))
    return center, quaternion, linear, angular
