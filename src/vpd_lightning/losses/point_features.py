"""Squared error of renderer input features at points of the workspace (paper appendix, "Sequential")."""

from jaxtyping import Float
from torch import Tensor

from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.types import SimulatorOutput, VideoBatch


class PointFeatureLoss(AbstractLoss):
    """Mean squared difference of the features at the same points under predicted and under encoded particles.

    Averaged over steps, points and features; needs no correspondences between the two sets of particles. Most points of
    a workspace are empty, which makes that number tiny, so ``point_features_near`` reports its size at the points
    whose ``point_mass`` (sum of the narrowest kernel over the encoded particles) is above ``min_mass``.
    """

    name = "point_features"

    def __init__(self, *, weight: float, min_mass: float):
        super().__init__()
        if weight < 0 or min_mass < 0:
            raise ValueError(f"weight and min_mass must not be negative, got weight={weight}, min_mass={min_mass}")
        self.weight, self.min_mass = weight, min_mass
        self._metrics: dict[str, Tensor] = {}

    @property
    def metrics(self) -> dict[str, Tensor]:
        """The loss of the last call at points near particles; 0 where there were none."""
        return self._metrics

    def forward(self, output: SimulatorOutput, batch: VideoBatch) -> Float[Tensor, ""]:
        """Return the error over ``predicted_features`` and ``target_features`` (``batch time point feature``).

        Raises:
            ConfigError: the system computes no features at points.
        """
        missing = {"predicted_features", "target_features", "point_mass"} - set(output.auxiliary)
        if missing:
            raise ConfigError(
                f"the loss point_features needs {' and '.join(sorted(missing))}, which this system does not compute.\n"
                "It belongs to model=sequential."
            )
        squared = (output.auxiliary["predicted_features"] - output.auxiliary["target_features"]).square()
        near = output.auxiliary["point_mass"] > self.min_mass
        at_points = squared.detach().mean(dim=-1)
        self._metrics = {"point_features_near": (at_points * near).sum() / near.sum().clamp(min=1)}
        return squared.mean()
