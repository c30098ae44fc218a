"""Pictures by OpenGL through ``mujoco.Renderer``: antialiased RGB, and depth and segmentation in passes of their own.

Depth must not come from the antialiased pass: a multisample depth belongs to an off-centre point of the pixel (4 mm
median error on the floor at 2 m). ``MUJOCO_GL`` must be set before MuJoCo is imported (see ``data_gen.gl_backend``).
"""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from data_gen.labels import Labels
from data_gen.scene_settings import CameraSettings

_FAR_SHARE = 0.99  # sky comes back as the far plane


class GLRenderer:
    """Renders a model's cameras ``view0``, ``view1``, ...; close it before another is opened in the same process."""

    def __init__(self, model: Any, camera: CameraSettings, labels: Labels, backend: str) -> None:
        self.model = model
        self.name = backend
        self.far = _FAR_SHARE * model.vis.map.zfar * model.stat.extent
        self.labels = labels
        self.camera_ids = [model.camera(f"view{view}").id for view in range(camera.num_views)]
        self.renderer = mujoco.Renderer(model, camera.height, camera.width)

    def close(self) -> None:
        """Free the GL context."""
        self.renderer.close()

    def render(
        self, data: Any, rgb: NDArray[np.uint8], depth: NDArray[np.float32], segmentation: NDArray[np.uint8]
    ) -> None:
        """Fill ``rgb`` (view, height, width, 3), ``depth`` (metres, 0 = nothing) and ``segmentation``."""
        renderer = self.renderer
        for view, camera_id in enumerate(self.camera_ids):
            renderer.update_scene(data, camera_id)
            rgb[view] = renderer.render()
            renderer.enable_depth_rendering()
            planar = renderer.render()
            depth[view] = np.where(planar < self.far, planar, 0.0)
            renderer.disable_depth_rendering()
            renderer.enable_segmentation_rendering()
            segmentation[view] = self._labelled(renderer.render())
            renderer.disable_segmentation_rendering()

    def _labelled(self, drawn: NDArray[np.int32]) -> NDArray[np.uint8]:
        """Turn MuJoCo's (object id, object type) per pixel into our labels; anything else is background."""
        index, kind = drawn[..., 0], drawn[..., 1]
        image = np.zeros(index.shape, np.uint8)
        # As plain integers: NumPy compares with an enumeration element by element, in 18 ms instead of 0.1.
        for object_type, values in (
            (int(mujoco.mjtObj.mjOBJ_GEOM), self.labels.geoms),
            (int(mujoco.mjtObj.mjOBJ_FLEX), self.labels.flexes),
        ):
            chosen = (kind == object_type) & (index >= 0)
            if chosen.any():
                image[chosen] = values[index[chosen]]
        return image
