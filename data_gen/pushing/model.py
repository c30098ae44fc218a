"""The MuJoCo model of one trajectory: table, floor, bodies, the pusher and its control, cameras."""

from typing import Any

import numpy as np

from data_gen.cameras import camera_xml, mjcf_numbers
from data_gen.labels import Labels
from data_gen.pushing.arm import PUSHER, ROLLING, controls_xml, tool_xml
from data_gen.pushing.bodies import PlacedBody
from data_gen.pushing.settings import PushingSettings
from vpd_lightning.data.schema import DRIVEN_LABEL


def compile_model(settings: PushingSettings, bodies: list[PlacedBody]) -> Any:
    """Return the compiled model: body i + 1 is object i, its free joint joint i; then the pusher's two joints."""
    import mujoco

    return mujoco.MjModel.from_xml_string(_scene_xml(settings, bodies))


def labels_of(model: Any, num_bodies: int) -> Labels:
    """Return the labels of a compiled model: table and floor 0, body i + 1 i + 1, the pusher ``DRIVEN_LABEL``."""
    owners = np.asarray(model.geom_bodyid).astype(np.int64)
    return Labels(np.where(owners > num_bodies, DRIVEN_LABEL, owners).astype(np.uint8), np.empty(0, np.uint8))


def _scene_xml(settings: PushingSettings, bodies: list[PlacedBody]) -> str:
    table, light, pusher = settings.table, settings.light, settings.pusher
    top = [*table.half_size, table.thickness / 2]
    foot = [0.6 * table.half_size[0], 0.6 * table.half_size[1], (table.height - table.thickness) / 2]
    friction = f"{table.friction!r} {ROLLING}"
    return f"""
<mujoco model="pushing">
  <option timestep="{settings.timestep!r}" integrator="implicitfast" cone="elliptic"/>
  <visual>
    <global offwidth="{settings.camera.width}" offheight="{settings.camera.height}"/>
    <quality shadowsize="2048" offsamples="{settings.num_multisamples}"/>
    <map znear="0.02" zfar="{4 * settings.far!r}" shadowclip="4"/>
    <headlight active="1" ambient="{mjcf_numbers([light.ambient] * 3)}" diffuse="0 0 0" specular="0 0 0"/>
  </visual>
  <statistic extent="1" center="0 0 0"/>
  <asset>
    <texture name="sky" type="skybox" builtin="flat" width="8" height="48" rgb1="0.86 0.89 0.92" rgb2="0.86 0.89 0.92"/>
    <material name="table" rgba="{mjcf_numbers(table.color)} 1" specular="0" shininess="0"/>
    <material name="floor" rgba="{mjcf_numbers(table.floor_color)} 1" specular="0" shininess="0"/>
    <material name="arm" rgba="{mjcf_numbers(settings.arm.color)} 1" specular="0" shininess="0"/>
    <material name="{PUSHER}" rgba="{mjcf_numbers(pusher.color)} 1" specular="0" shininess="0"/>
    {"".join(_material(number, body) for number, body in enumerate(bodies))}
  </asset>
  <worldbody>
    <light directional="true" castshadow="true" pos="{mjcf_numbers(-2 * np.asarray(light.direction))}"
      dir="{mjcf_numbers(light.direction)}" ambient="0 0 0" diffuse="{mjcf_numbers([light.diffuse] * 3)}"
      specular="0 0 0"/>
    <geom name="floor" type="plane" pos="0 0 {-table.height!r}" size="3 3 1" material="floor" friction="{friction}"/>
    <geom name="top" type="box" pos="0 0 {-table.thickness / 2!r}" size="{mjcf_numbers(top)}" material="table"
      friction="{friction}"/>
    <geom name="foot" type="box" pos="0 0 {-(table.height + table.thickness) / 2!r}" size="{mjcf_numbers(foot)}"
      material="table" friction="{friction}"/>
    {"".join(_body(number, body) for number, body in enumerate(bodies))}
    {tool_xml(settings)}
    {camera_xml(settings.camera)}
  </worldbody>
  <actuator>
    {controls_xml(settings)}
  </actuator>
</mujoco>"""


def _material(number: int, body: PlacedBody) -> str:
    """A checker on all sides, so that a turn is seen."""
    light, dark = (mjcf_numbers(color) for color in body.colors)
    return (
        f'<texture name="body{number}" type="cube" builtin="checker" width="64" height="64" rgb1="{light}"'
        f' rgb2="{dark}"/>'
        f'<material name="body{number}" texture="body{number}" specular="0" shininess="0"/>'
    )


def _body(number: int, body: PlacedBody) -> str:
    # Capsules lie: along x instead of z.
    turn = 'euler="0 90 0"' if body.shape == "capsule" else ""
    return (
        f'<body name="body{number}"><freejoint/><geom name="body{number}" type="{body.shape}" {turn}'
        f' size="{mjcf_numbers(body.mjcf_size)}" mass="{body.mass!r}" material="body{number}" condim="6"'
        f' friction="{body.friction!r} {ROLLING}"/></body>'
    )
