"""Sequential training (paper appendix, "Sequential"): first encoder and renderer, then the dynamics on their features.

The ablation of end-to-end training: the same stages, the same use. Two trainings, with a system for each.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.encoder.base import AbstractEncoder
from vpd_lightning.errors import ConfigError
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.renderer.features.sample_features import SampleFeatures
from vpd_lightning.simulator import Simulator
from vpd_lightning.types import Particles, RGBDFrames, SimulatorOutput, VideoBatch


@runtime_checkable
class _OffersPointFeatures(Protocol):
    """A renderer whose input features can be queried at any point."""

    num_neighbors: int
    kernel_radii: tuple[float, ...]
    kernel_bandwidths: tuple[float, ...]

    def point_features(
        self, particles: Particles, queries: Float[Tensor, "batch query 3"]
    ) -> Float[Tensor, "batch query feature"]:
        """Return what the radiance field would be given at the points."""


class AutoEncoder(Simulator):
    """The first training: encoder and renderer on single frames, whose rays are those of the encoded frame.

    Frames, rays, subsampling and location noise are those of end-to-end training; nothing moves. ``dynamics`` has
    nothing to learn here, so it must have no weights; with ``PersistenceDynamics`` an evaluation sees
    a static scene.
    """

    # Paper: says "auto-encoder pre-training" only; frames, rays and noise as in the end-to-end model are our reading.

    def __init__(
        self,
        *,
        encoder: AbstractEncoder,
        dynamics: AbstractDynamics,
        renderer: AbstractRenderer,
        location_noise: float,
        checkpoint_dynamics: bool,
    ):
        super().__init__(
            encoder=encoder,
            dynamics=dynamics,
            renderer=renderer,
            location_noise=location_noise,
            checkpoint_dynamics=checkpoint_dynamics,
            pixel_gradient_to_motion=1.0,
        )
        if any(True for _ in dynamics.parameters()):
            raise ValueError(
                f"an auto-encoder trains no dynamics: set dynamics=persistence, got {type(dynamics).__name__}"
            )

    def forward(self, batch: VideoBatch) -> SimulatorOutput:
        """Encode each frame of ``batch.future`` and render the rays of that frame.

        Raises:
            ConfigError: the batch holds no future frames.
        """
        future = _future(batch)
        encoded = [
            self.encoder(future[:, step], batch.keys, f"future/{step}") for step in range(batch.rays.origins.shape[1])
        ]
        states = [self._add_location_noise(one.particles, batch.keys, step) for step, one in enumerate(encoded)]
        rendered = self._render_steps(states, batch.rays, batch.keys if self.training else None)
        return SimulatorOutput(rendered, states)


class SequentialSimulator(Simulator):
    """The second training: the dynamics alone, by the renderer's input features instead of by pixels.

    Predicted particles and those encoded from the true frames of the same step have no correspondences. So both are
    compared by the renderer's input features at the same ``num_points`` points, drawn anew for every training step
    and predicted step, uniformly in the box from ``workspace_min`` to ``workspace_max`` (metres). Encoder
    and renderer are frozen: their weights come from an ``AutoEncoder``. In use it is a ``Simulator`` like any other.

    # Paper: compares at the next time step; here ``data.num_steps`` steps are compared (1: the next one alone), and
    # the loss is the mean over them.
    """

    def __init__(
        self,
        *,
        encoder: AbstractEncoder,
        dynamics: AbstractDynamics,
        renderer: AbstractRenderer,
        location_noise: float,
        checkpoint_dynamics: bool,
        num_points: int,
        workspace_min: Sequence[float],
        workspace_max: Sequence[float],
    ):
        super().__init__(
            encoder=encoder,
            dynamics=dynamics,
            renderer=renderer,
            location_noise=location_noise,
            checkpoint_dynamics=checkpoint_dynamics,
            pixel_gradient_to_motion=1.0,
        )
        if num_points < 1:
            raise ValueError(f"num_points must be at least 1, got {num_points}")
        if any(low >= high for low, high in zip(workspace_min, workspace_max, strict=True)):
            raise ValueError(f"workspace_min {list(workspace_min)} must lie below workspace_max {list(workspace_max)}")
        if not isinstance(renderer, _OffersPointFeatures):
            raise ValueError(
                f"{type(renderer).__name__} has no features at points to compare; set renderer=point_nerf or surface"
            )
        self.num_points = num_points
        self.workspace_min, self.workspace_max = list(workspace_min), list(workspace_max)
        for frozen in (self.encoder, self.renderer):
            frozen.requires_grad_(False)

    def train(self, mode: bool = True) -> "SequentialSimulator":
        """Set the mode of the dynamics; encoder and renderer stay in evaluation mode."""
        super().train(mode)
        self.encoder.eval()
        self.renderer.eval()
        return self

    def forward(self, batch: VideoBatch) -> SimulatorOutput:
        """Roll out and compare features: ``predicted_features`` and ``target_features`` (``batch time point feature``).

        ``point_mass`` (``batch time point``) measures how near to encoded particles a point is, see ``narrowest_mass``.

        Raises:
            ConfigError: the batch holds no future frames.
        """
        future = _future(batch)
        num_steps = future.depth.shape[1]
        with torch.no_grad():
            previous = self.encoder(batch.context[:, 0], batch.keys, "previous").particles
            current = self.encoder(batch.context[:, 1], batch.keys, "current").particles
            targets = [self.encoder(future[:, t], batch.keys, f"future/{t}").particles for t in range(num_steps)]
        states = self.unroll(previous, current, num_steps, batch.keys)
        points = [self.draw_points(batch.keys, step).to(current.positions) for step in range(num_steps)]
        assert isinstance(self.renderer, _OffersPointFeatures)
        predicted = [self.renderer.point_features(*pair) for pair in zip(states, points, strict=True)]
        with torch.no_grad():
            wanted = [self.renderer.point_features(*pair) for pair in zip(targets, points, strict=True)]
            masses = [narrowest_mass(self.renderer, *pair) for pair in zip(targets, points, strict=True)]
        return SimulatorOutput(
            None,
            states,
            {
                "predicted_features": torch.stack(predicted, dim=1),
                "target_features": torch.stack(wanted, dim=1),
                "point_mass": torch.stack(masses, dim=1),
            },
        )

    def draw_points(self, keys: RandomKeys, rollout_step: int) -> Float[Tensor, "batch point 3"]:
        """Return uniform points of the workspace (metres), other ones for every predicted step."""
        low, high = torch.tensor(self.workspace_min), torch.tensor(self.workspace_max)
        draws = [torch.rand(self.num_points, 3, generator=g) for g in keys.generators(f"points/{rollout_step}")]
        return torch.minimum(low + torch.stack(draws) * (high - low), high)  # the sum may be rounded up


def narrowest_mass(
    renderer: _OffersPointFeatures, particles: Particles, points: Float[Tensor, "batch point 3"]
) -> Float[Tensor, "batch point"]:
    """Return the sum over the nearest particles of the kernel that reaches least far, at each point."""
    reaches = [r + b for r, b in zip(renderer.kernel_radii, renderer.kernel_bandwidths, strict=True)]
    narrowest = reaches.index(min(reaches))
    masses = SampleFeatures(
        replace(particles, features=torch.ones_like(particles.positions[..., :1])),
        num_neighbors=renderer.num_neighbors,
        kernel_radii=renderer.kernel_radii[narrowest : narrowest + 1],
        kernel_bandwidths=renderer.kernel_bandwidths[narrowest : narrowest + 1],
        max_radius=None,
        neighbors_backend="auto",
        features_backend="auto",
        is_sorted=False,
        is_checkpointed=False,
        variant=None,
    )(points[:, :, None])
    return masses[:, :, 0, 0]


def _future(batch: VideoBatch) -> RGBDFrames:
    if batch.future is None:
        raise ConfigError(
            "this training encodes the frames that are to be predicted, and the data do not bring them.\n"
            "Set data.load_future=true."
        )
    return batch.future
