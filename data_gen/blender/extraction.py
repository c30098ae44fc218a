"""What ``mujoco.Renderer`` would draw of a model, as plain arrays for Blender.

MuJoCo itself says what is drawn: its abstract scene (``mjvScene``, which needs no GL) lists the visible shapes with
their final colours, the flexes' skins and the lights. Only triangles and texture coordinates are made here.
"""

from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from data_gen.blender import shapes, textures
from data_gen.blender.lights import ambient_light, describe_lights, linear
from data_gen.blender.materials import Materials
from data_gen.blender.messages import Arrays
from vpd_lightning.errors import RenderingBackendError

_MAX_GEOMS = 10_000
_TYPES = mujoco.mjtGeom
_DRAWN = (mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_FLEX)
_SHARP_COSINE = 0.8  # MuJoCo shows an edge where a mesh's normal leans further from its face

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Drawn:
    """The MuJoCo object behind one shape or skin."""

    object_type: int
    object_id: int


@dataclass(frozen=True)
class Extraction:
    """Everything that does not change with time: what is drawn, and the message that describes it to Blender."""

    drawn: list[Drawn]
    head: dict[str, Any]
    arrays: Arrays


class AbstractScene:
    """MuJoCo's list of what is visible in a model."""

    def __init__(self, model: Any) -> None:
        self.model = model
        self.option = mujoco.MjvOption()
        self.camera = mujoco.MjvCamera()
        self.scene = mujoco.MjvScene(model, _MAX_GEOMS)

    def update(self, data: Any) -> list[Any]:
        """Read the state and return the ``mjvGeom`` of everything that is drawn."""
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self.model, data, self.option, None, self.camera, everything, self.scene)
        return [geom for geom in self.scene.geoms[: self.scene.ngeom] if geom.objtype in _DRAWN]

    def skin(self, flex: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return corners and normals (face * 3, 3) of the skin MuJoCo draws: the FEM surface grown by ``radius``."""
        start = 9 * int(self.scene.flexfaceadr[flex])
        corners = slice(start, start + 9 * int(self.scene.flexfaceused[flex]))
        vertices, normals = self.scene.flexface[corners], self.scene.flexnormal[corners]
        return vertices.reshape(-1, 3).copy(), normals.reshape(-1, 3).copy()


def extract(abstract: AbstractScene, data: Any, camera_ids: list[int]) -> Extraction:
    """Describe a model; ``data`` is any state of it with forward kinematics done.

    Raises:
        RenderingBackendError: the model holds something that the Blender export does not support.
    """
    model, scene = abstract.model, abstract.scene
    geoms = abstract.update(data)
    if model.nskin:
        raise _not_drawn("a skin")
    cameras = np.asarray(data.cam_xpos)[camera_ids]
    materials = Materials(model, scene)
    drawn, objects = [], []
    arrays: Arrays = {}
    for number, geom in enumerate(geoms):
        is_flex = geom.objtype == mujoco.mjtObj.mjOBJ_FLEX
        triangles = _skin(abstract, geom.objid) if is_flex else _triangles(model, geom)
        lookup, coordinates = materials.add(geom, triangles)
        if lookup:
            arrays[f"object{number}.{lookup}"] = coordinates.astype(np.float32)
        arrays[f"object{number}.vertices"] = triangles.vertices.astype(np.float32)
        arrays[f"object{number}.faces"] = triangles.faces
        arrays[f"object{number}.normals"] = triangles.normals.astype(np.float32)
        drawn.append(Drawn(int(geom.objtype), int(geom.objid)))
        objects.append({"is_flex": is_flex, "surrounds": not is_flex and _surrounds(geom, triangles.vertices, cameras)})
    arrays |= {f"image{number}": image for number, image in enumerate(materials.images)}
    sky = textures.skybox(model)
    if sky is not None:
        arrays["sky"] = sky
    lights, unknown = describe_lights(scene)
    if unknown:
        raise _not_drawn(f"a light of type {unknown[0]}")
    extent = float(model.stat.extent)
    head = {
        "objects": objects,
        "materials": materials.described,
        "images": len(materials.images),
        "lights": lights,
        "ambient": linear(ambient_light(scene)).tolist(),
        "fovy": [float(np.radians(model.cam_fovy[camera])) for camera in camera_ids],
        "near": float(model.vis.map.znear) * extent,
        "far": float(model.vis.map.zfar) * extent,
    }
    return Extraction(drawn, head, arrays)


def _triangles(model: Any, geom: Any) -> shapes.Triangles:
    size = np.asarray(geom.size, float)
    if geom.type == _TYPES.mjGEOM_PLANE:
        return _plane(model, size)
    if geom.type == _TYPES.mjGEOM_BOX:
        return shapes.box(size)
    if geom.type in (_TYPES.mjGEOM_SPHERE, _TYPES.mjGEOM_ELLIPSOID):
        return shapes.ellipsoid(size)
    if geom.type == _TYPES.mjGEOM_CYLINDER:
        return shapes.cylinder(size[0], size[2])
    if geom.type == _TYPES.mjGEOM_CAPSULE:
        return shapes.capsule(size[0], size[2])
    if geom.type in (_TYPES.mjGEOM_MESH, _TYPES.mjGEOM_SDF):
        return _mesh(model, geom)
    raise _not_drawn(f"a geom of type {_TYPES(geom.type).name[len('mjGEOM_') :].lower()}")


def _plane(model: Any, size: Floats) -> shapes.Triangles:
    """Return a plane's rectangle; where it is infinite it reaches beyond sight, and its texture counts in metres."""
    reach = 2 * float(model.vis.map.zfar) * float(model.stat.extent)
    half = np.where(size[:2] > 0, size[:2], reach)
    rectangle = shapes.plane(half[0], half[1])
    metres = rectangle.unit[:, :2] * half * [0.5, -0.5]
    shift = [0.0 if length > 0 else -0.5 for length in size[:2]]
    return replace(rectangle, chart=np.where(size[:2] > 0, rectangle.chart, metres), shift=(shift[0], shift[1]))


def _mesh(model: Any, geom: Any) -> shapes.Triangles:
    mesh = int(geom.dataid) // 2  # odd numbers are convex hulls
    start, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]].astype(float)
    normals = model.mesh_normal[model.mesh_normaladr[mesh] :][: model.mesh_normalnum[mesh]]
    faces = model.mesh_face[start : start + count].astype(np.int32)
    corner_normals = normals[model.mesh_facenormal[start : start + count].ravel()].astype(float)
    if not geom.texcoord:
        across = shapes.face_normals(vertices, faces)
        is_smooth = (corner_normals * across).sum(axis=1, keepdims=True) >= _SHARP_COSINE
        corner_normals = np.where(is_smooth, corner_normals, across)
    return shapes.from_mesh(vertices, faces, corner_normals, np.asarray(geom.size, float))


def _skin(abstract: AbstractScene, flex: int) -> shapes.Triangles:
    vertices, normals = abstract.skin(flex)
    if not len(vertices):
        raise _not_drawn("a one-dimensional flex")
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return shapes.from_mesh(vertices.astype(float), faces, normals.astype(float), np.ones(3))


def _surrounds(geom: Any, vertices: Floats, cameras: Floats) -> bool:
    """Tell whether all cameras stand within the shape's box: a dome or a room, which must not shut the light out."""
    if geom.type == _TYPES.mjGEOM_PLANE:
        return False
    local = (cameras - np.asarray(geom.pos)) @ np.asarray(geom.mat, float).reshape(3, 3)
    return bool(((local > vertices.min(axis=0)) & (local < vertices.max(axis=0))).all())


def _not_drawn(what: str) -> RenderingBackendError:
    return RenderingBackendError(
        f"renderer=blender does not draw {what}, which this scene has.\nUse renderer=egl or renderer=osmesa for it."
    )
