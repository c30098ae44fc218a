"""Pictures by OpenGL through ``mujoco.Renderer``: antialiased RGB, and depth and segmentation in passes of their own.

Depth must not come from the antialiased pass: a multisample depth belongs to an off-centre point of the pixel (4 mm
median error on the floor at 2 m). ``MUJOCO_GL`` must be set before MuJoCo is imported (see ``data_gen.gl_backend``).
"""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from data_gen.mujoco_block_settings import MujocoBlockSettings
from data_gen.raycast import floor_color

_FLOOR, _BLOCK = 0, 1
_FAR_SHARE = 0.99  # sky comes back as the far plane
# Which face of a MuJoCo cube texture (right left up down front back) shows which colour of +x -x +y -y +z -z.
CUBE_FACES = (0, 1, 2, 3, 4, 5)


class GLRenderer:
    """Renders the block scene with GL; same interface as ``RaycastRenderer``."""

    def __init__(self, settings: MujocoBlockSettings, model: Any) -> None:
        self.model = model
        self.far = _FAR_SHARE * model.vis.map.zfar * model.stat.extent
        paint_textures(settings, model)
        self.renderer = mujoco.Renderer(model, settings.camera.height, settings.camera.width)

    def close(self) -> None:
        """Free the GL context."""
        self.renderer.close()

    def render(
        self, data: Any, rgb: NDArray[np.uint8], depth: NDArray[np.float32], segmentation: NDArray[np.uint8]
    ) -> None:
        """Fill ``rgb`` (view, height, width, 3), ``depth`` (metres, 0 = nothing) and ``segmentation``."""
        renderer = self.renderer
        for view in range(len(rgb)):
            renderer.update_scene(data, view)
            rgb[view] = renderer.render()
            renderer.enable_depth_rendering()
            planar = renderer.render()
            depth[view] = np.where(planar < self.far, planar, 0.0)
            renderer.disable_depth_rendering()
            renderer.enable_segmentation_rendering()
            segmentation[view] = renderer.render()[..., 0] == _BLOCK
            renderer.disable_segmentation_rendering()


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
