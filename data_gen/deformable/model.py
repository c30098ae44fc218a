"""The MuJoCo model of a few soft bodies above a floor: tetrahedral flexes of Stable Neo-Hookean material.

MuJoCo's default material (St Venant-Kirchhoff) turns tetrahedra inside out in collisions and never recovers; the
Neo-Hookean one (Smith, de Goes and Kim 2018) does not. It can only be chosen through ``MjSpec`` and needs the
``discrete`` integrator (MuJoCo 3.15 or later).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.cameras import camera_xml
from data_gen.cameras import mjcf_numbers as _text
from data_gen.deformable.settings import DeformableSettings
from data_gen.deformable.shapes import shapes
from data_gen.deformable.tetrahedra import TetrahedralMesh

_NEO_HOOKEAN = 1  # mjsFlex.elastic3d
_TEXTURE_SIZE = 64  # pixels per period of the floor's pattern


def vertex_masses(mesh: TetrahedralMesh, density: float) -> NDArray[np.float64]:
    """Return the mass of each vertex (vertex,) in kg: a quarter of that of each tetrahedron around it."""
    masses = np.zeros(len(mesh.vertices))
    np.add.at(masses, mesh.tetrahedra, (density * mesh.volumes / 4)[:, None])
    return masses


def build_model(settings: DeformableSettings, names: Sequence[str], meshes: Sequence[TetrahedralMesh]) -> Any:
    """Return the compiled ``mujoco.MjModel``.

    The bodies are flexes 0, 1, ... in the given order, in their own frames: vertex i of the model (over all flexes) has
    the coordinates ``qpos[3 i : 3 i + 3]``, its displacement in m along the world's axes from its place in the mesh.
    """
    import mujoco

    spec = mujoco.MjSpec.from_string(_scene_xml(settings, names, meshes))
    for flex, mesh in zip(spec.flexes, meshes, strict=True):
        flex.elastic3d = _NEO_HOOKEAN
        # MuJoCo gives all vertices the same mass, which pulls the centre of mass towards finely meshed parts.
        for body_name, mass in zip(flex.vertbody, vertex_masses(mesh, settings.bodies.density), strict=True):
            spec.body(body_name).mass = mass
    model = spec.compile()
    _paint_floor(settings, model)
    return model


def _scene_xml(settings: DeformableSettings, names: Sequence[str], meshes: Sequence[TetrahedralMesh]) -> str:
    bodies = "".join(
        _body_xml(settings, f"body{i}", name, mesh) for i, (name, mesh) in enumerate(zip(names, meshes, strict=True))
    )
    contact, floor, light = settings.contact, settings.floor, settings.light
    background = _text(floor.background)
    return f"""
<mujoco model="deformable">
  <option timestep="{settings.timestep!r}" integrator="discrete" solver="{contact.solver}"
    tolerance="{contact.tolerance!r}" iterations="{contact.iterations}">
    <flag autoreset="disable"/>
  </option>
  <size memory="200M"/>
  <visual>
    <global offwidth="{settings.camera.width}" offheight="{settings.camera.height}"/>
    <quality shadowsize="{light.shadow_size}" offsamples="{settings.num_multisamples}"/>
    <map znear="0.1" zfar="{4 * settings.far!r}" shadowclip="{1.5 * floor.half_size!r}"/>
    <headlight active="1" ambient="{_text([light.ambient] * 3)}" diffuse="0 0 0" specular="0 0 0"/>
    <rgba haze="{background} 1"/>
  </visual>
  <statistic extent="1" center="0 0 0"/>
  <asset>
    <texture name="sky" type="skybox" builtin="flat" width="8" height="48" rgb1="{background}" rgb2="{background}"/>
    <texture name="floor" type="2d" builtin="flat" width="{_TEXTURE_SIZE}" height="{_TEXTURE_SIZE}" rgb1="1 1 1"/>
    <material name="floor" texture="floor" texuniform="true" specular="0" shininess="0"
      texrepeat="{1 / floor.tile!r} {1 / floor.tile!r}"/>
  </asset>
  <worldbody>
    <light directional="true" castshadow="true" pos="{_text(-10 * np.asarray(light.direction))}"
      dir="{_text(light.direction)}" ambient="0 0 0" diffuse="{_text([light.diffuse] * 3)}" specular="0 0 0"/>
    <geom name="floor" type="plane" size="{floor.half_size!r} {floor.half_size!r} {floor.half_size!r}" material="floor"
      {_contact_xml(settings)}/>
    {bodies}
    {camera_xml(settings.camera)}
  </worldbody>
</mujoco>"""


def _body_xml(settings: DeformableSettings, label: str, name: str, mesh: TetrahedralMesh) -> str:
    bodies, color = settings.bodies, settings.bodies.colors[name]
    flat = "true" if shapes()[name].has_flat_faces else "false"
    mass = bodies.density * float(mesh.volumes.sum())
    return f"""
    <flexcomp name="{label}" type="direct" dim="3" radius="{bodies.skin!r}" mass="{mass!r}" rgba="{_text(color)} 1"
      flatskin="{flat}" point="{_text(mesh.vertices.ravel())}" element="{" ".join(map(str, mesh.tetrahedra.ravel()))}">
      <elasticity young="{bodies.young!r}" poisson="{bodies.poisson!r}" damping="{bodies.damping!r}"/>
      <contact selfcollide="none" condim="3" {_contact_xml(settings)}/>
    </flexcomp>"""


def _contact_xml(settings: DeformableSettings) -> str:
    contact = settings.contact
    return f'friction="{contact.friction!r}" solref="{_text(contact.solref)}" solimp="{_text(contact.solimp)}"'


def _paint_floor(settings: DeformableSettings, model: Any) -> None:
    """Write one period of the soft checker (two tiles each way) into the texture, before a renderer uploads it."""
    texture = model.texture("floor")
    angle = 2 * np.pi * (np.arange(_TEXTURE_SIZE) + 0.5) / _TEXTURE_SIZE
    pattern = settings.floor.contrast * np.tanh(3.0 * np.sin(angle)[:, None] * np.sin(angle))
    image = np.rint(255 * np.clip(pattern[..., None] + settings.floor.color, 0, 1)).astype(np.uint8)
    start = int(texture.adr[0])
    model.tex_data[start : start + image.size] = image.reshape(-1)
