"""The pixel loss against values computed by hand."""

import pytest
import torch

from vpd_lightning.losses.pixel import PixelLoss
from vpd_lightning.testing.scenes import video_batch
from vpd_lightning.types import RenderedRays, SimulatorOutput


def loss_of(loss: PixelLoss, coarse: float | None) -> float:
    """Black truth (two steps of rays); one prediction is grey 0.5 in its first step and black in its second."""
    batch = video_batch(1)
    batch.rgbs.zero_()
    assert batch.rgbs.shape[1] == 2
    rgbs = torch.zeros_like(batch.rgbs)
    rgbs[:, 0] = 0.5
    coarse_rgbs = None if coarse is None else torch.full_like(rgbs, coarse)
    rendered = RenderedRays(rgbs, torch.ones_like(rgbs[..., 0]), torch.ones_like(rgbs[..., 0]), coarse_rgbs)
    return float(loss(SimulatorOutput(rendered, []), batch))


@pytest.mark.parametrize(
    ("coarse_weight", "coarse", "expected"),
    [
        (1.0, None, 0.125),  # 0.25 in one of two steps
        (0.1, None, 0.125),
        (1.0, 0.2, 0.125 + 0.04),
        (0.5, 0.2, 0.125 + 0.02),
        (0.0, 0.2, 0.125),
    ],
)
def test_mean_squared_error_of_both_tiers(coarse_weight: float, coarse: float | None, expected: float) -> None:
    loss = PixelLoss(weight=3.0, coarse_weight=coarse_weight)  # its own weight is the caller's business
    assert loss_of(loss, coarse) == pytest.approx(expected, rel=1e-12)


def test_no_error_is_no_loss() -> None:
    batch = video_batch(2)
    rendered = RenderedRays(batch.rgbs, batch.rgbs[..., 0], batch.rgbs[..., 0], batch.rgbs)
    assert PixelLoss(weight=1.0, coarse_weight=1.0)(SimulatorOutput(rendered, []), batch) == 0


@pytest.mark.parametrize(("weight", "coarse_weight"), [(-1.0, 1.0), (1.0, -0.1)])
def test_negative_weights_are_refused(weight: float, coarse_weight: float) -> None:
    with pytest.raises(ValueError, match=f"got weight={weight}, coarse_weight={coarse_weight}"):
        PixelLoss(weight=weight, coarse_weight=coarse_weight)
