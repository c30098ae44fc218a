"""Build Blender's scene from arrays. Runs under Blender's Python: ``bpy``, NumPy and the standard library only."""

import math
from typing import Any

import bpy  # type: ignore[import-not-found]
import numpy as np

_SENSOR = 32.0  # mm; any value gives the same picture, the focal length follows the field of view
_SUN_ANGLE = math.radians(2.0)  # angular diameter: softens shadows (the real sun has half a degree)
_SPOT_RADIUS = 0.05  # m
# Watts of a lamp with constant falloff that light a white surface facing it as a sun of strength pi does.
_LAMP_WATTS = 4.0 * math.pi * math.pi


class BlenderScene:
    """The objects, lights and cameras of one scene; ``place`` moves them to a frame."""

    def __init__(self, head: dict[str, Any], arrays: dict[str, Any], width: int, height: int) -> None:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = bpy.context.scene
        self.collection = self.scene.collection
        self.images = [_image(f"image{i}", arrays[f"image{i}"]) for i in range(head["images"])]
        self.objects = [
            self._object(number, described, head["materials"][number], arrays)
            for number, described in enumerate(head["objects"])
        ]
        self.is_flex = [described["is_flex"] for described in head["objects"]]
        self._world(head["ambient"], arrays.get("sky"))
        self.lights = [(self._light(described), described["is_headlight"]) for described in head["lights"]]
        self.cameras = [self._camera(view, fovy, head) for view, fovy in enumerate(head["fovy"])]
        self.scene.render.resolution_x, self.scene.render.resolution_y = width, height
        self.scene.render.resolution_percentage = 100

    def place(self, arrays: dict[str, Any]) -> None:
        """Move everything to where it is in one frame."""
        for number, thing in enumerate(self.objects):
            if self.is_flex[number]:
                _move_skin(thing.data, arrays[f"object{number}.vertices"], arrays[f"object{number}.normals"])
            else:
                thing.matrix_world = _matrix(arrays["rotations"][number], arrays["positions"][number])
        for view, camera in enumerate(self.cameras):
            camera.matrix_world = _matrix(arrays["camera_rotations"][view], arrays["camera_positions"][view])

    def look_through(self, view: int) -> None:
        """Make one camera the active one; headlights follow it."""
        self.scene.camera = self.cameras[view]
        for light, is_headlight in self.lights:
            if is_headlight:
                light.matrix_world = self.cameras[view].matrix_world

    def _object(self, number: int, described: dict[str, Any], material: dict[str, Any], arrays: dict[str, Any]) -> Any:
        prefix = f"object{number}."
        mesh = bpy.data.meshes.new(prefix)
        # Every face has vertices of its own: Cycles keeps one normal per vertex, and sharp edges have two.
        vertices = arrays[prefix + "vertices"][arrays[prefix + "faces"].ravel()]
        mesh.vertices.add(len(vertices))
        mesh.vertices.foreach_set("co", vertices.ravel())
        mesh.loops.add(len(vertices))
        mesh.loops.foreach_set("vertex_index", np.arange(len(vertices), dtype=np.int32))
        mesh.polygons.add(len(vertices) // 3)
        mesh.polygons.foreach_set("loop_start", np.arange(0, len(vertices), 3, dtype=np.int32))
        mesh.update(calc_edges=True)
        mesh.attributes.new("custom_normal", "FLOAT_VECTOR", "CORNER")
        _set_vectors(mesh, "custom_normal", arrays[prefix + "normals"])
        if material["lookup"] == "uv":
            mesh.uv_layers.new(name="uv")
            mesh.uv_layers["uv"].uv.foreach_set("vector", arrays[prefix + "uv"].ravel())
        elif material["lookup"] == "direction":
            mesh.attributes.new("direction", "FLOAT_VECTOR", "CORNER")
            _set_vectors(mesh, "direction", arrays[prefix + "direction"])
        mesh.materials.append(self._material(prefix, material))
        thing = bpy.data.objects.new(prefix, mesh)
        thing.pass_index = number + 1
        thing.shadow_terminator_geometry_offset = 0.0  # else coarse skins with smooth normals show blotches
        if described["surrounds"]:  # a dome or a room: seen, but light comes in through it
            thing.visible_shadow = thing.visible_diffuse = thing.visible_transmission = False
        self.collection.objects.link(thing)
        return thing

    def _material(self, name: str, described: dict[str, Any]) -> Any:
        material = bpy.data.materials.new(name)
        material.use_nodes = True
        material.cycles.emission_sampling = "NONE"  # emission shows, but does not light other things, as in MuJoCo
        nodes, links = material.node_tree.nodes, material.node_tree.links
        shader = nodes["Principled BSDF"]
        shader.inputs["Base Color"].default_value = (*described["color"], 1.0)
        shader.inputs["Roughness"].default_value = described["roughness"]
        shader.inputs["Metallic"].default_value = described["metallic"]
        shader.inputs["Specular IOR Level"].default_value = described["specular"]
        shader.inputs["Alpha"].default_value = described["alpha"]
        shader.inputs["Emission Color"].default_value = (*described["color"], 1.0)
        shader.inputs["Emission Strength"].default_value = described["emission"]
        if described["image"] < 0:
            return material
        if described["lookup"] == "uv":
            picture, place = nodes.new("ShaderNodeTexImage"), nodes.new("ShaderNodeUVMap")
            place.uv_map = "uv"
            links.new(place.outputs["UV"], picture.inputs["Vector"])
        else:
            picture, place = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeAttribute")
            place.attribute_name = "direction"
            links.new(place.outputs["Vector"], picture.inputs["Vector"])
        picture.image = self.images[described["image"]]
        for target in ("Base Color", "Emission Color"):
            links.new(picture.outputs["Color"], shader.inputs[target])
        return material

    def _world(self, ambient: list[float], sky: Any) -> None:
        """Light from everywhere; the camera sees the sky's picture, or black, instead of it."""
        world = bpy.data.worlds.new("world")
        self.scene.world = world
        world.cycles.sampling_method = "NONE"  # an even light needs no importance map, which takes seconds a view
        world.use_nodes = True
        nodes, links = world.node_tree.nodes, world.node_tree.links
        nodes.clear()
        output, mix = nodes.new("ShaderNodeOutputWorld"), nodes.new("ShaderNodeMixShader")
        everywhere, seen = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeBackground")
        everywhere.inputs["Color"].default_value = (*ambient, 1.0)
        seen.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
        if sky is not None:
            picture = nodes.new("ShaderNodeTexEnvironment")
            picture.image = _image("sky", sky)
            links.new(picture.outputs["Color"], seen.inputs["Color"])
        links.new(nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"], mix.inputs[0])
        links.new(everywhere.outputs[0], mix.inputs[1])
        links.new(seen.outputs[0], mix.inputs[2])
        links.new(mix.outputs[0], output.inputs["Surface"])

    def _light(self, described: dict[str, Any]) -> Any:
        strength = np.asarray(described["strength"], float)
        peak = float(strength.max())
        is_sun = described["is_headlight"] or described["kind"] == "sun"
        lamp = bpy.data.lights.new("light", "SUN" if is_sun else "SPOT")
        lamp.color = (strength / max(peak, 1e-9)).tolist()
        lamp.use_shadow = described["casts_shadow"]
        if is_sun:
            lamp.energy, lamp.angle = math.pi * peak, _SUN_ANGLE
        else:  # MuJoCo's spots do not fade with distance
            lamp.energy, lamp.shadow_soft_size = _LAMP_WATTS * peak, _SPOT_RADIUS
            lamp.spot_size, lamp.spot_blend = min(math.pi, 2 * described["cutoff"]), 0.1
            lamp.use_nodes = True
            nodes, links = lamp.node_tree.nodes, lamp.node_tree.links
            falloff = nodes.new("ShaderNodeLightFalloff")
            falloff.inputs["Strength"].default_value = 1.0
            links.new(falloff.outputs["Constant"], nodes["Emission"].inputs["Strength"])
        thing = bpy.data.objects.new("light", lamp)
        thing.matrix_world = _matrix(_aim(described["direction"]), described["position"])
        self.collection.objects.link(thing)
        return thing

    def _camera(self, view: int, fovy: float, head: dict[str, Any]) -> Any:
        lens = bpy.data.cameras.new(f"view{view}")
        lens.sensor_fit = "VERTICAL"
        lens.sensor_height = _SENSOR
        lens.lens = 0.5 * _SENSOR / math.tan(0.5 * fovy)
        lens.clip_start, lens.clip_end = head["near"], head["far"]
        thing = bpy.data.objects.new(f"view{view}", lens)
        self.collection.objects.link(thing)
        return thing


def _image(name: str, picture: Any) -> Any:
    """Make an sRGB image; row 0 of ``picture`` lies at v = 0, as in Blender."""
    height, width, _ = picture.shape
    image = bpy.data.images.new(name, width, height, alpha=False)
    values = np.ones((height, width, 4), np.float32)
    values[..., :3] = picture.astype(np.float32) / 255.0
    image.pixels.foreach_set(values.ravel())
    image.update()
    return image


def _move_skin(mesh: Any, vertices: Any, normals: Any) -> None:
    mesh.vertices.foreach_set("co", vertices.ravel())
    _set_vectors(mesh, "custom_normal", normals)
    mesh.update()


def _set_vectors(mesh: Any, name: str, values: Any) -> None:
    mesh.attributes[name].data.foreach_set("vector", values.ravel())


def _matrix(rotation: Any, position: Any) -> Any:
    from mathutils import Matrix  # type: ignore[import-not-found]

    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return Matrix(matrix.tolist())


def _aim(direction: list[float]) -> Any:
    """Return a rotation whose -z axis, along which lamps shine, points along ``direction``."""
    back = -np.asarray(direction, float)
    back /= np.linalg.norm(back)
    side = np.cross([0.0, 1.0, 0.0] if abs(back[1]) < 0.9 else [1.0, 0.0, 0.0], back)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(back, side), back], axis=1)
