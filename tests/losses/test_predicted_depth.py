"""The depth loss against values computed by hand."""

from dataclasses import replace

import pytest
import torch

from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.predicted_depth import PredictedDepthLoss
from vpd_lightning.testing.scenes import video_batch
from vpd_lightning.types import SimulatorOutput


def output_of(depth):
    return SimulatorOutput(None, [], {"predicted_depth": depth})


def flat_batch(size=2):
    """Everything is 2 m away in the current frame, and 7 m in the previous one, which does not count."""
    batch = video_batch(size)
    depth = torch.full_like(batch.context.depth, 2.0)
    depth[:, 0] = 7.0
    return replace(batch, context=replace(batch.context, depth=depth))


def test_mean_square_and_mean_distance_in_metres():
    batch, loss = flat_batch(), PredictedDepthLoss(weight=1.0, far=5.0)
    predicted = torch.full_like(batch.context.depth[:, 1], 2.0)
    predicted[0, 0] = 2.5  # half a metre too far in one of four images
    predicted[1, 0] = 1.0  # one metre too near in another

    assert float(loss(output_of(predicted), batch)) == pytest.approx((0.25 + 1.0) / 4)
    assert float(loss.metrics["predicted_depth_error"]) == pytest.approx((0.5 + 1.0) / 4)


@pytest.mark.parametrize("unmeasured", [0.0, -1.0, float("nan"), float("inf"), 5.1])
def test_what_was_not_measured_or_is_too_far_does_not_count(unmeasured):
    batch, loss = flat_batch(), PredictedDepthLoss(weight=1.0, far=5.0)
    batch.context.depth[0, 1, :, :8] = unmeasured
    predicted = torch.full_like(batch.context.depth[:, 1], 2.5).requires_grad_()

    value = loss(output_of(predicted), batch)
    value.backward()

    assert value.item() == pytest.approx(0.25)  # over the measured pixels of each member, not over all
    assert torch.isfinite(predicted.grad).all()
    assert not predicted.grad[0, :, :8].any() and (predicted.grad[0, :, 8:] > 0).all()


def test_a_member_without_any_measurement_adds_nothing():
    batch, loss = flat_batch(), PredictedDepthLoss(weight=1.0, far=5.0)
    batch.context.depth[0, 1] = float("nan")
    predicted = torch.full_like(batch.context.depth[:, 1], 2.5).requires_grad_()

    value = loss(output_of(predicted), batch)
    value.backward()

    assert value.item() == pytest.approx(0.125) and torch.isfinite(predicted.grad).all()


def test_an_encoder_that_measures_is_named_as_the_reason():
    with pytest.raises(ConfigError, match="encoder=unet_depth"):
        PredictedDepthLoss(weight=1.0, far=5.0)(SimulatorOutput(None, []), flat_batch())


@pytest.mark.parametrize("changes", [{"weight": -1.0}, {"far": 0.0}])
def test_wrong_settings_are_refused(changes):
    with pytest.raises(ValueError, match="weight=.*far="):
        PredictedDepthLoss(**({"weight": 1.0, "far": 5.0} | changes))
