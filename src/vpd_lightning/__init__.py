"""Visual Particle Dynamics: learn a 3D particle simulator from posed RGB-D video.

Nothing heavy is imported until it is used: ``load`` and ``Simulator`` bring in PyTorch, ``import vpd_lightning`` does
not.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from vpd_lightning.moved import install as _find_moved_modules

if TYPE_CHECKING:
    from vpd_lightning.editing.scene_editor import SceneEditor
    from vpd_lightning.loading import load
    from vpd_lightning.planning.plan import plan
    from vpd_lightning.simulator import Rollout, Scene, Simulator
    from vpd_lightning.types import Cameras, Driven, Particles

try:
    __version__ = version("vpd-lightning")
except PackageNotFoundError:  # a checkout on the path that was never installed
    __version__ = "0+unknown"

_find_moved_modules()

_HOMES = {
    "Cameras": "vpd_lightning.types",
    "Driven": "vpd_lightning.types",
    "Particles": "vpd_lightning.types",
    "Rollout": "vpd_lightning.simulator",
    "Scene": "vpd_lightning.simulator",
    "SceneEditor": "vpd_lightning.editing.scene_editor",
    "Simulator": "vpd_lightning.simulator",
    "load": "vpd_lightning.loading",
    "plan": "vpd_lightning.planning.plan",
}

__all__ = [
    "Cameras",
    "Driven",
    "Particles",
    "Rollout",
    "Scene",
    "SceneEditor",
    "Simulator",
    "__version__",
    "load",
    "plan",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
