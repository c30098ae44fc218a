"""What a renderer is, and which one draws a compiled MuJoCo model."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from data_gen.labels import Labels
from data_gen.scene_settings import SceneSettings


class Renderer(Protocol):
    """Draws all cameras of one model."""

    @property
    def name(self) -> str:
        """What draws; stands in each file."""
        ...

    def render(
        self, data: Any, rgb: NDArray[np.uint8], depth: NDArray[np.float32], segmentation: NDArray[np.uint8]
    ) -> None:
        """Fill (view, height, width, 3), (view, height, width) z-depth in metres, 0 = nothing, and labels."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


def open_renderer(backend: str, model: Any, settings: SceneSettings, labels: Labels) -> Renderer:
    """Return a renderer of ``model``; ``backend`` is ``egl``, ``osmesa`` or ``blender``.

    GL backends need ``MUJOCO_GL`` set before MuJoCo is imported, which ``data_gen.worker`` does.
    """
    if backend == "blender":
        from data_gen.blender.renderer import BlenderRenderer

        return BlenderRenderer(model, settings.camera, labels, samples=settings.blender_samples)
    from data_gen.gl import GLRenderer

    return GLRenderer(model, settings.camera, labels, backend)
