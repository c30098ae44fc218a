"""Public contract tests: what the simulator relies on in an encoder, a dynamics, a renderer or a loss.

Subclass the contract of your stage in a pytest module of your own and say how your component is built:

    from vpd_lightning.testing import DynamicsContract

    class TestMyDynamics(DynamicsContract):
        def build(self):
            return MyDynamics(feature_dim=self.feature_dim)

See docs/adding_a_component.md. The scenes that the contracts use are public as well.
"""

from vpd_lightning.testing.dynamics_contract import DynamicsContract
from vpd_lightning.testing.encoder_contract import EncoderContract
from vpd_lightning.testing.loss_contract import LossContract
from vpd_lightning.testing.renderer_contract import RendererContract
from vpd_lightning.testing.scenes import (
    FAR,
    FEATURE_DIM,
    IMAGE_SIZE,
    NEAR,
    NUM_VIEWS,
    WORKSPACE_MAX,
    WORKSPACE_MIN,
    ball_frames,
    ball_particles,
    keys_for,
    ring_cameras,
    scene_rays,
    video_batch,
)

__all__ = [
    "FAR",
    "FEATURE_DIM",
    "IMAGE_SIZE",
    "NEAR",
    "NUM_VIEWS",
    "WORKSPACE_MAX",
    "WORKSPACE_MIN",
    "DynamicsContract",
    "EncoderContract",
    "LossContract",
    "RendererContract",
    "ball_frames",
    "ball_particles",
    "keys_for",
    "ring_cameras",
    "scene_rays",
    "video_batch",
]
