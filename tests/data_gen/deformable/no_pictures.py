"""A renderer that draws nothing, for tests of the physics on machines without GL."""

from typing import Any

import numpy as np
import pytest

from data_gen.deformable import scene
from data_gen.deformable.scene import DeformableScene
from data_gen.deformable.settings import DeformableSettings


class NoPictures:
    name = "none"

    def __init__(self, *_: Any) -> None:
        pass

    def render(self, data: Any, rgb: np.ndarray, depth: np.ndarray, segmentation: np.ndarray) -> None:
        for image in (rgb, depth, segmentation):
            image[:] = 0

    def close(self) -> None:
        pass


def blind_scene(settings: DeformableSettings, monkeypatch: pytest.MonkeyPatch) -> DeformableScene:
    monkeypatch.setattr(scene, "open_renderer", NoPictures)
    return DeformableScene(settings, "none")
