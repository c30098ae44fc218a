"""A robot's links as points on their surfaces, carried by its joints: MJCF or URDF, by MuJoCo's forward kinematics."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.settings import did_you_mean
from vpd_lightning.data.driven_motion import DrivenMotion
from vpd_lightning.errors import ConfigError, DataError

Array = NDArray[np.float64]

_FIRST_HIDDEN_GROUP = 3  # MuJoCo's custom: geoms of groups 0 to 2 are seen, others collide
_UNITS = {"rad": 1.0, "deg": np.pi / 180}


@dataclass(frozen=True)
class RobotModel:
    """Points and outward normals (point, 3) in each link's own frame, metres; ``groups`` are places in ``links``.

    ``links`` are MuJoCo's numbers of those bodies that have a shape.
    """

    path: Path
    model: Any
    links: tuple[int, ...]
    points: Array
    normals: Array
    groups: NDArray[np.int32]

    @property
    def link_names(self) -> list[str]:
        return [self.model.body(link).name for link in self.links]

    def addresses(self, joints: Sequence[str | None]) -> list[tuple[int, int] | None]:
        """Return for each joint its place among MuJoCo's positions and its type; None for what is no joint.

        Raises:
            ConfigError: the model has no such joint, or it has more than one degree of freedom.
        """
        import mujoco

        single = [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)]
        known = {self.model.joint(i).name: i for i in range(self.model.njnt) if int(self.model.jnt_type[i]) in single}
        found: list[tuple[int, int] | None] = []
        for name in joints:
            if name is not None and name not in known:
                raise ConfigError(
                    f"{self.path} has no joint {name!r}{did_you_mean(name, tuple(known))}\n"
                    f"Joints of one degree of freedom: {', '.join(known) or 'none'}."
                )
            index = None if name is None else known[name]
            found.append(
                None if index is None else (int(self.model.jnt_qposadr[index]), int(self.model.jnt_type[index]))
            )
        return found

    def poses(self, joints: Sequence[str | None], positions: Array, unit: str, base: Array) -> Array:
        """Return link to world (time, link, 4, 4).

        Args:
            joints: the model's joint of each column; None for a column that is none (a gripper's current, say). Joints
                that are not named stay where the model has them.
            positions: (time, joint); metres of sliding joints, else in ``unit``.
            unit: ``rad`` or ``deg``.
            base: (4, 4), the model's world to the cameras' world.

        Raises:
            ConfigError: a joint that the model does not have.
            DataError: another number of columns than joints, or positions that are not finite.
        """
        import mujoco

        addresses = self.addresses(joints)
        if positions.ndim != 2 or positions.shape[1] != len(joints):
            raise DataError(f"joint positions have shape {positions.shape}; {len(joints)} joints are named.")
        if not np.isfinite(positions).all():
            raise DataError("joint positions are not finite everywhere.")
        data = mujoco.MjData(self.model)
        poses = np.tile(np.eye(4), (len(positions), len(self.links), 1, 1))
        for frame, row in enumerate(positions):
            for value, address in zip(row, addresses, strict=True):
                if address is not None:
                    is_hinge = address[1] == int(mujoco.mjtJoint.mjJNT_HINGE)
                    data.qpos[address[0]] = value * (_UNITS[unit] if is_hinge else 1.0)
            mujoco.mj_kinematics(self.model, data)
            poses[frame, :, :3, :3] = data.xmat[list(self.links)].reshape(-1, 3, 3)
            poses[frame, :, :3, 3] = data.xpos[list(self.links)]
        return base @ poses

    def motion(self, poses: Array, commanded_poses: Array | None = None) -> DrivenMotion:
        """Carry the points along poses (time, link, 4, 4)."""
        return DrivenMotion.carried(self.points, self.normals, self.groups, poses, commanded_poses)


def load_robot(path: Path, num_points: int) -> RobotModel:
    """Read a model and spread points over the surfaces of its links, by area.

    Shapes are those that are seen; of links that have none, those that collide. Planes and height fields are no robot.

    Raises:
        ConfigError: there is no such file, MuJoCo cannot read it, or it has no shapes.
    """
    import mujoco
    import trimesh

    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file; a robot's MJCF or URDF is needed.")
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ConfigError(f"{path} cannot be read as MJCF or URDF: {' '.join(str(error).split())[:300]}") from error
    surfaces: dict[int, list[Any]] = {}
    for body in range(model.nbody):
        geoms = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == body]
        shown = [geom for geom in geoms if model.geom_group[geom] < _FIRST_HIDDEN_GROUP] or geoms
        meshes = [mesh for geom in shown if (mesh := _surface(model, geom)) is not None]
        if meshes:
            surfaces[body] = meshes
    if not surfaces:
        raise ConfigError(
            f"{path} has no shapes: boxes, spheres, cylinders, capsules, ellipsoids or meshes are needed."
        )
    whole: dict[int, Any] = {body: trimesh.util.concatenate(meshes) for body, meshes in surfaces.items()}
    area = sum(mesh.area for mesh in whole.values())
    points, normals, groups = [], [], []
    for group, mesh in enumerate(whole.values()):
        count = max(1, round(num_points * mesh.area / area))
        places, faces = trimesh.sample.sample_surface(mesh, count, seed=group)[:2]
        points.append(np.asarray(places))
        normals.append(np.asarray(mesh.face_normals[faces]))
        groups.append(np.full(count, group, np.int32))
    return RobotModel(path, model, tuple(whole), *(np.concatenate(part) for part in (points, normals, groups)))


def _surface(model: Any, geom: int) -> Any | None:
    """Return one shape as a mesh in its body's frame; None for planes and height fields."""
    import mujoco
    import trimesh
    from scipy.spatial.transform import Rotation

    size, kind = model.geom_size[geom], mujoco.mjtGeom(model.geom_type[geom])
    kinds = mujoco.mjtGeom
    if kind == kinds.mjGEOM_BOX:
        mesh = trimesh.creation.box(extents=2 * size)
    elif kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID):
        mesh = trimesh.creation.icosphere(subdivisions=3)
        mesh.apply_scale(size if kind == kinds.mjGEOM_ELLIPSOID else size[0])
    elif kind == kinds.mjGEOM_CYLINDER:
        mesh = trimesh.creation.cylinder(radius=size[0], height=2 * size[1])
    elif kind == kinds.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(radius=size[0], height=2 * size[1])
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    elif kind == kinds.mjGEOM_MESH:
        index = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[index], model.mesh_vertnum[index]
        first_face, num_faces = model.mesh_faceadr[index], model.mesh_facenum[index]
        mesh = trimesh.Trimesh(
            model.mesh_vert[first : first + count],
            model.mesh_face[first_face : first_face + num_faces],
            process=False,
        )
    else:
        return None
    place = np.eye(4)
    place[:3, :3] = Rotation.from_quat(model.geom_quat[geom], scalar_first=True).as_matrix()
    place[:3, 3] = model.geom_pos[geom]
    mesh.apply_transform(place)
    return mesh
