"""A small MuJoCo scene with one of everything that the Blender export supports, and what is needed to render it."""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from data_gen.blender.process import find_python
from data_gen.cameras import camera_xml
from data_gen.labels import Labels
from data_gen.scene_settings import CameraSettings
from vpd_lightning.errors import ConfigError

CAMERA = CameraSettings(
    num_views=2,
    height=64,
    width=80,
    field_of_view=40.0,
    radius=3.0,
    elevation_min=20.0,
    elevation_max=60.0,
    target=[0.0, 0.0, 0.2],
)
WEDGE = (
    '<mesh name="wedge" vertex="-.25 -.25 -.2 .25 -.25 -.2 .25 .25 -.2 -.25 .25 -.2 -.25 -.25 .2 .25 -.25 .2"'
    ' texcoord="0 0 1 0 1 1 0 1 0 .5 1 .5" face="0 2 1 0 3 2 0 1 5 0 5 4 1 2 5 0 4 3 3 4 5 3 5 2"/>'
)
BOX_POSITION, BOX_HALF = np.array([-0.5, -0.4, 0.2]), np.array([0.2, 0.15, 0.2])
TINT = np.array([1.0, 0.5, 1.0])


def missing_blender() -> str | None:
    """Return why Blender cannot be used here, or None."""
    try:
        find_python()
    except ConfigError as error:
        return f"needs Blender's environment (make blender): {str(error).splitlines()[0]}"
    return None


def scene_xml(extra: str = "", flatskin: str = "false") -> str:
    """Return the MJCF text; ``extra`` joins the world body."""
    return f"""
<mujoco>
  <visual>
    <global offwidth="80" offheight="64"/>
    <quality shadowsize="1024" offsamples="4"/>
    <headlight ambient=".35 .35 .35" diffuse="0 0 0" specular="0 0 0"/>
    <map znear="0.02" zfar="20" shadowclip="3"/>
  </visual>
  <asset>
    <texture name="flat" type="2d" builtin="flat" width="64" height="32"/>
    <texture name="cube" type="cube" builtin="flat" width="16" height="96"/>
    <texture name="sky" type="skybox" builtin="flat" width="8" height="48"/>
    <material name="flat" texture="flat" texrepeat="2 1" texuniform="true"/>
    <material name="tinted" texture="flat" rgba="{" ".join(map(str, TINT))} 1"/>
    <material name="cube" texture="cube"/>
    {WEDGE}
  </asset>
  <worldbody>
    <light pos="0 0 4" dir=".4 .3 -1" directional="true" diffuse=".6 .6 .6"/>
    <geom name="floor" type="plane" size="3 3 .1" material="flat"/>
    <geom name="box" type="box" size=".2 .15 .2" pos="-.5 -.4 .2" material="cube"/>
    <geom name="ball" type="sphere" size=".2" pos=".5 -.4 .2" material="cube"/>
    <geom name="can" type="cylinder" size=".15 .2" pos=".5 .4 .3" euler="60 20 0" material="tinted"/>
    <geom name="pill" type="capsule" size=".1 .2" pos="0 .7 .3" euler="40 0 0" rgba=".2 .4 .8 1"/>
    <geom name="wedge" type="mesh" mesh="wedge" pos="-.5 .5 .2" material="tinted"/>
    <geom name="ghost" type="box" size=".5 .5 .5" pos="0 0 .5" rgba="1 0 0 0"/>
    <geom name="hidden" type="box" size=".5 .5 .5" pos="0 0 .5" group="3"/>
    <flexcomp name="soft" type="grid" dim="3" count="3 3 3" spacing=".12 .12 .12" radius="0.02" rgba=".3 .7 .3 1"
     mass="1" pos="0 0 .5" flatskin="{flatskin}"><edge equality="true"/><contact selfcollide="none"/></flexcomp>
    {extra}
    {camera_xml(CAMERA)}
  </worldbody>
</mujoco>"""


def small_scene(extra: str = "", flatskin: str = "false") -> tuple[Any, Any, Labels]:
    """Return model, data after kinematics, and labels: geom id + 1, flexes from 101."""
    model = mujoco.MjModel.from_xml_string(scene_xml(extra, flatskin))
    for texture in range(model.ntex):
        paint(model, texture)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    labels = Labels(np.arange(1, model.ngeom + 1, dtype=np.uint8), np.arange(101, model.nflex + 101, dtype=np.uint8))
    return model, data, labels


def paint(model: Any, texture: int) -> None:
    """Give every texel a colour that tells where it is: column, row, face."""
    height, width, start = (int(array[texture]) for array in (model.tex_height, model.tex_width, model.tex_adr))
    row, column = np.mgrid[:height, :width]
    face = row // width if height > width else np.zeros_like(row)
    image = np.stack([255 * column / width, 255 * (row % max(1, min(height, width))) / width, 40 * face + 10], axis=-1)
    model.tex_data[start : start + image.size] = image.astype(np.uint8).ravel()


def pictures() -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint8]]:
    """Return empty rgb, depth and segmentation."""
    shape = (CAMERA.num_views, CAMERA.height, CAMERA.width)
    return np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
