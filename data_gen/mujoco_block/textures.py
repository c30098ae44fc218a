"""The floor's pattern and the block's six colours, written into the textures of the compiled model."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.mujoco_block.raycast import floor_color
from data_gen.mujoco_block.settings import MujocoBlockSettings

# Which face of a MuJoCo cube texture (right left up down front back) shows which colour of +x -x +y -y +z -z.
CUBE_FACES = (0, 1, 2, 3, 4, 5)


def paint_textures(settings: MujocoBlockSettings, model: Any) -> None:
    """Write the floor's pattern and the six face colours into the model's textures (before a renderer uploads them)."""
    for texture, paint in ((model.texture("floor"), _floor), (model.texture("block"), _block)):
        height, width = int(texture.height[0]), int(texture.width[0])
        start = int(texture.adr[0])
        image = np.rint(255 * np.clip(paint(settings, height, width), 0, 1)).astype(np.uint8)
        model.tex_data[start : start + image.size] = image.reshape(-1)


def _floor(settings: MujocoBlockSettings, height: int, width: int) -> NDArray[np.float64]:
    """One period of the pattern: two tiles in each direction."""
    period = 2 * settings.floor.tile
    x, y = np.meshgrid((np.arange(width) + 0.5) / width * period, (np.arange(height) + 0.5) / height * period)
    # MuJoCo lays the texture from the plane's corner, and the rows of a texture go against y.
    corner = settings.floor.half_size
    return floor_color(np.stack([x - corner, corner - y], axis=-1), settings)


def _block(settings: MujocoBlockSettings, height: int, width: int) -> NDArray[np.float64]:
    colors = np.asarray(settings.block.face_colors)[list(CUBE_FACES)]
    return np.broadcast_to(np.repeat(colors, height // 6, axis=0)[:, None], (height, width, 3))
