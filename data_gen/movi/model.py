"""The MuJoCo model of one trajectory: objects, surroundings, cameras and the contacts between them."""

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.cameras import camera_xml, mjcf_numbers
from data_gen.labels import Labels
from data_gen.movi.contacts import Surface, option_xml, pair_xml
from data_gen.movi.mesh_xml import mesh_xml, paint, part_attributes, texture_xml
from data_gen.movi.settings import MoviSettings
from data_gen.movi.surroundings import Surroundings, surroundings_assets, surroundings_bodies
from data_gen.movi.throwing import ThrownObject

HIDDEN_GROUP = 3  # of what collides but is not seen; renderers draw groups 0 to 2
# Of drawn spheres and cylinders: within 3 mm of a true sphere 1.4 m across. 64 and 32 (1.7 mm) cost a fifth more time.
SPHERE_SLICES, SPHERE_STACKS = 48, 24
# m, half the side of the square that the sun's shadow map covers. Towards its border on the sun's side a lit floor gets
# speckles, so it is wider than the lit floor; one texel is 6 cm, less than a pixel at the middle of the scene.
_SHADOW_REACH = 32.0


@dataclass(frozen=True, eq=False)
class _Body:
    """The MJCF of one object."""

    assets: str
    body: str
    geoms: list[str]  # names of what collides
    textures: dict[str, NDArray[np.uint8]]


def compile_model(settings: MoviSettings, objects: list[ThrownObject], look: Surroundings) -> Any:
    """Return the compiled model: body i + 1 is object i, its free joint joint i; textures are painted."""
    import mujoco

    bodies = [_body(f"object{number}", thrown) for number, thrown in enumerate(objects)]
    model = mujoco.MjModel.from_xml_string(_scene_xml(settings, objects, bodies, look))
    textures = {name: image for body in bodies for name, image in body.textures.items()}
    if look.floor_texture is not None:
        textures["floor"] = look.floor_texture
    if look.dome_texture is not None:
        textures["dome"] = look.dome_texture
    for name, image in textures.items():
        paint(model, name, image)
    return model


def labels_of(model: Any) -> Labels:
    """Return the labels of a compiled model: the world body's geoms 0, those of body i + 1 i + 1."""
    return Labels(np.asarray(model.geom_bodyid).astype(np.uint8), np.empty(0, np.uint8))


def _scene_xml(settings: MoviSettings, objects: list[ThrownObject], bodies: list[_Body], look: Surroundings) -> str:
    ambient = mjcf_numbers([settings.light.ambient] * 3)
    return f"""
<mujoco model="movi">
  {option_xml(settings.timestep)}
  <visual>
    <global offwidth="{settings.camera.width}" offheight="{settings.camera.height}"/>
    <quality shadowsize="1024" offsamples="{settings.num_multisamples}" numslices="{SPHERE_SLICES}"
      numstacks="{SPHERE_STACKS}"/>
    <map znear="0.05" zfar="{3 * settings.floor.dome_radius!r}" shadowclip="{_SHADOW_REACH!r}"/>
    <headlight active="1" ambient="{ambient}" diffuse="0 0 0" specular="0 0 0"/>
  </visual>
  <statistic extent="1" center="0 0 0"/>
  <asset>
    {surroundings_assets(settings, look)}
    {"".join(body.assets for body in bodies)}
  </asset>
  <worldbody>
    {surroundings_bodies(settings)}
    {"".join(body.body for body in bodies)}
    {camera_xml(settings.camera)}
  </worldbody>
  <contact>{_pairs_xml(settings, objects, bodies)}</contact>
</mujoco>"""


def _pairs_xml(settings: MoviSettings, objects: list[ThrownObject], bodies: list[_Body]) -> str:
    floor = Surface(settings.floor.friction, settings.floor.restitution)
    surfaces = [Surface(thrown.material.friction, thrown.material.restitution) for thrown in objects]
    pairs = []
    for surface, body in zip(surfaces, bodies, strict=True):
        pairs += [pair_xml("floor", geom, floor.against(surface)) for geom in body.geoms]
    for (surface, body), (other, another) in combinations(zip(surfaces, bodies, strict=True), 2):
        contact = surface.against(other)
        pairs += [pair_xml(first, second, contact) for first in body.geoms for second in another.geoms]
    return "".join(pairs)


def _body(name: str, thrown: ThrownObject) -> _Body:
    item, material = thrown.item, thrown.material
    assets, textures = "", {}
    finish = (
        f'rgba="{mjcf_numbers(thrown.color)} 1" specular="{material.specular!r}" shininess="{material.shininess!r}"'
    )
    if item.mesh.texture is not None:
        textures[name] = item.mesh.texture
        assets += texture_xml(name, item.mesh.texture)
        finish += f' texture="{name}"'
    assets += f'<material name="{name}" {finish}/>'
    geoms, names = [], []
    if not item.is_primitive:
        assets += mesh_xml(name, item.mesh)
        geoms.append(f'<geom type="mesh" mesh="{name}" material="{name}" contype="0" conaffinity="0"/>')
    for number, part in enumerate(item.parts):
        geom = f"{name}_{number}"
        if part.mesh is not None:
            assets += mesh_xml(geom, part.mesh)
        looks = f'material="{name}"' if item.is_primitive else f'group="{HIDDEN_GROUP}"'
        geoms.append(f'<geom name="{geom}" {part_attributes(part, geom)} {looks} contype="0" conaffinity="0"/>')
        names.append(geom)
    inertia = item.inertia * material.density
    order = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    inertial = (
        f'<inertial pos="0 0 0" mass="{thrown.mass!r}"'
        f' fullinertia="{mjcf_numbers([float(inertia[index]) for index in order])}"/>'
    )
    body = f'<body name="{name}"><freejoint/>{inertial}{"".join(geoms)}</body>'
    return _Body(assets, body, names, textures)
