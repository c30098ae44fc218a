"""MuJoCo's materials for Blender: colours in linear light, texture coordinates, and the pictures they look into."""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from data_gen.blender import textures
from data_gen.blender.lights import ambient_light, linear
from data_gen.blender.shapes import Triangles

_TYPES = mujoco.mjtGeom
_RAW = (_TYPES.mjGEOM_MESH, _TYPES.mjGEOM_SDF, _TYPES.mjGEOM_PLANE)  # drawn at their size, not as scaled unit shapes

Floats = NDArray[np.float64]


class Materials:
    """Collects the materials of one scene; a picture that several share is kept once."""

    def __init__(self, model: Any, scene: Any) -> None:
        self.model = model
        self.scene = scene
        self.described: list[dict[str, Any]] = []
        self.images: list[NDArray[np.uint8]] = []
        self._numbers: dict[tuple[Any, ...], int] = {}

    def add(self, geom: Any, triangles: Triangles) -> tuple[str, Floats]:
        """Describe the material of an ``mjvGeom``.

        Returns:
            How its texture is looked up, and with which values per corner: ``uv`` into a picture, ``direction`` into a
            panorama, or an empty word where there is no texture.
        """
        model, material = self.model, int(geom.matid)
        rgba = np.asarray(geom.rgba, float)
        ambient = ambient_light(self.scene)
        roughness = float(model.mat_roughness[material]) if material >= 0 else -1.0
        metallic = float(model.mat_metallic[material]) if material >= 0 else -1.0
        texture = textures.texture_of_material(model, material)
        lookup, coordinates = ("", np.zeros((0, 2))) if texture < 0 else self._coordinates(geom, texture, triangles)
        self.described.append(
            {
                "color": linear(rgba[:3]).tolist(),
                "alpha": float(rgba[3]),
                "specular": 0.5 * float(geom.specular),  # Blender's also mirrors the surroundings
                "roughness": roughness if roughness >= 0 else 1.0 - 0.5 * float(geom.shininess),
                "metallic": max(0.0, metallic),
                "emission": float(np.mean(linear(ambient + geom.emission) - linear(ambient))),
                "lookup": lookup,
                "image": self._image(texture, lookup, rgba[:3]) if lookup else -1,
            }
        )
        return lookup, coordinates

    def _coordinates(self, geom: Any, texture: int, triangles: Triangles) -> tuple[str, Floats]:
        model, material, size = self.model, int(geom.matid), np.asarray(geom.size, float)
        is_uniform = bool(model.mat_texuniform[material])
        if geom.type == _TYPES.mjGEOM_FLEX:
            if not geom.texcoord:  # MuJoCo's colours are not defined there
                return "", np.zeros((0, 2))
            start = 6 * int(self.scene.flexfaceadr[geom.objid])
            values = self.scene.flextexcoord[start : start + 2 * len(triangles.normals)]
            return "uv", values.reshape(-1, 2).astype(float)
        if geom.texcoord:
            return "uv", self._mesh_coordinates(int(geom.dataid) // 2)
        if textures.is_flat(model, texture):
            repeat = np.asarray(model.mat_texrepeat[material], float)
            return "uv", textures.flat_coordinates(triangles, repeat, size, is_uniform)
        if geom.type == _TYPES.mjGEOM_BOX and (not is_uniform or np.ptp(size) == 0):
            return "uv", textures.box_coordinates(triangles.unit, int(model.tex_width[texture]))
        corners = triangles.vertices[triangles.faces.ravel()] if geom.type in _RAW else triangles.unit
        return "direction", corners * size if is_uniform else corners

    def _mesh_coordinates(self, mesh: int) -> Floats:
        model = self.model
        faces = model.mesh_facetexcoord[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
        values = model.mesh_texcoord[model.mesh_texcoordadr[mesh] :][: model.mesh_texcoordnum[mesh]]
        return values[faces.ravel()].astype(float)

    def _image(self, texture: int, lookup: str, rgb: Floats) -> int:
        """Return the number of a texture's picture, multiplied with the material's colour in sRGB as MuJoCo does."""
        key = (texture, lookup, *rgb.tolist())
        if key not in self._numbers:
            picture = textures.pixels(self.model, texture)
            picture = textures.panorama(picture) if lookup == "direction" else picture
            self._numbers[key] = len(self.images)
            self.images.append(textures.tinted(picture, rgb))
        return self._numbers[key]
