"""An editor that can select by colour, whatever the encoder observes."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.editing.scene_editor import SceneEditor
from vpd_lightning.media.particle_colors import particle_colors
from vpd_lightning.simulator import Scene, Simulator
from vpd_lightning.types import Particles


def colored_editor(simulator: Simulator, scene: Scene, viewpoint: Float[Tensor, " 3"]) -> SceneEditor:
    """Return an editor of a scene; colours are those observed, or else what the renderer sees from ``viewpoint``."""
    if scene.current.colors is not None:
        return SceneEditor(scene)
    return SceneEditor(scene, *(_rendered(simulator, frame, viewpoint) for frame in (scene.previous, scene.current)))


def _rendered(simulator: Simulator, frame: Particles, viewpoint: Float[Tensor, " 3"]) -> Float[Tensor, "particle 3"]:
    colors = torch.zeros_like(frame.positions[0])
    if bool(frame.mask.any()):
        seen = torch.from_numpy(particle_colors(simulator.renderer, frame, viewpoint))
        colors[frame.mask[0]] = seen.to(colors) / 255
    return colors
