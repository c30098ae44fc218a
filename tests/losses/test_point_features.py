"""The loss on features at points against values computed by hand."""

import pytest
import torch

from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.point_features import PointFeatureLoss
from vpd_lightning.testing.scenes import video_batch
from vpd_lightning.types import SimulatorOutput


def output_of(mass):
    """Two steps, four points, three features; the first point of each step is 0.6 off in one feature."""
    target = torch.rand(2, 2, 4, 3, dtype=torch.float64)
    predicted = target.clone()
    predicted[:, :, 0, 1] += 0.6
    features = {"predicted_features": predicted, "target_features": target}
    return SimulatorOutput(None, [], {**features, "point_mass": torch.tensor(mass).expand(2, 2, 4)})


def test_mean_over_steps_points_and_features_and_that_near_particles():
    loss = PointFeatureLoss(weight=3.0, min_mass=0.1)

    value = loss(output_of([2.0, 0.2, 0.1, 0.0]), video_batch(2))

    assert float(value) == pytest.approx(0.36 / 12)
    assert float(loss.metrics["point_features_near"]) == pytest.approx(0.36 / 6)  # the first two of four points


def test_no_point_near_particles():
    loss = PointFeatureLoss(weight=1.0, min_mass=5.0)

    assert float(loss(output_of([2.0, 0.2, 0.1, 0.0]), video_batch(2))) > 0
    assert float(loss.metrics["point_features_near"]) == 0.0


def test_other_systems_are_told_where_it_belongs():
    with pytest.raises(ConfigError, match="model=sequential"):
        PointFeatureLoss(weight=1.0, min_mass=0.1)(SimulatorOutput(None, []), video_batch(2))


@pytest.mark.parametrize("changes", [{"weight": -1.0}, {"min_mass": -0.1}])
def test_negative_settings_are_refused(changes):
    with pytest.raises(ValueError, match="must not be negative"):
        PointFeatureLoss(**({"weight": 1.0, "min_mass": 0.1} | changes))
