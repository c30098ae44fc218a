"""The slot loss against values computed by hand, and the image loss in SlotFormer's units."""

import pytest
import torch
from torch import Tensor

from vpd_lightning.config import build_list, compose
from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.losses.slot import SlotLoss
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import RenderedRays, SimulatorOutput, ViewBatch


def batch_of(images: Tensor, num_history: int, slots: Tensor | None) -> ViewBatch:
    return ViewBatch(images, slots, num_history, RandomKeys.fixed(len(images)))


def output_of(rgbs: Tensor | None = None, **auxiliary: Tensor) -> SimulatorOutput:
    rendered = None if rgbs is None else RenderedRays(rgbs, rgbs[..., 0], rgbs[..., 0])
    return SimulatorOutput(rendered, [], auxiliary)


BATCH = batch_of(torch.zeros(2, 5, 4, 4, 3, dtype=torch.uint8), 2, None)


def test_mean_squared_error_over_everything() -> None:
    target = torch.zeros(2, 3, 4, 5, dtype=torch.float64)
    predicted = target.clone()
    predicted[0, 0, 0, 0], predicted[1, 2, 3, 4] = 3.0, -4.0
    loss = SlotLoss(weight=7.0)(output_of(predicted_slots=predicted, target_slots=target), BATCH)
    assert float(loss) == pytest.approx((9 + 16) / (2 * 3 * 4 * 5), rel=1e-12)  # its weight is the caller's business


def test_slots_are_not_matched() -> None:
    target = torch.randn(1, 2, 3, 4)
    swapped = target[:, :, [1, 0, 2]]
    assert float(SlotLoss(weight=1.0)(output_of(predicted_slots=swapped, target_slots=target), BATCH)) > 0.1


def test_gradients_reach_the_prediction_alone() -> None:
    predicted, target = (torch.randn(1, 2, 3, 4, requires_grad=True) for _ in range(2))
    SlotLoss(weight=1.0)(output_of(predicted_slots=predicted, target_slots=target), BATCH).backward()
    torch.testing.assert_close(predicted.grad, 2 * (predicted - target).detach() / 24)
    assert target.grad is None


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="weight must not be negative, got -1"):
        SlotLoss(weight=-1)
    with pytest.raises(ConfigError, match="needs predicted_slots, and this system has none"):
        SlotLoss(weight=1.0)(output_of(), BATCH)
    with pytest.raises(ValueError, match=r"shape \(1, 1, 3, 4\), stored ones \(1, 2, 3, 4\)"):
        slots = torch.zeros(1, 2, 3, 4)
        SlotLoss(weight=1.0)(output_of(predicted_slots=slots[:, :1], target_slots=slots), BATCH)


@pytest.mark.parametrize("option", ["slot", "view_pixel"])
def test_images_count_as_in_the_released_training(option: str) -> None:
    section = compose("train", [f"loss={option}", "data.folder=any", "run.folder=any"])["loss"]
    losses = {loss.name: loss for loss in build_list(section, AbstractLoss, "loss")}
    images = torch.randint(0, 256, (2, 5, 4, 4, 3), dtype=torch.uint8)
    slots = torch.zeros(2, 5, 3, 4) if option == "slot" else None
    shown = images[:, 2:] if option == "slot" else images
    decoded = torch.randn(*shown.shape[:2], 16, 3)  # of the network: nominally in [-1, 1]
    released = (decoded - (shown.flatten(2, 3) / 127.5 - 1)).square().mean()

    value = losses["pixel"](output_of((decoded + 1) / 2), batch_of(images, 2, slots))
    assert float(losses["pixel"].weight * value) == pytest.approx(float(released), rel=1e-5)
    assert set(losses) == ({"slot", "pixel"} if option == "slot" else {"pixel"})
    assert "slot" not in losses or losses["slot"].weight == 1.0
