"""The time-contrastive loss against loops over all triples, and what it is for."""

import pytest
import torch

from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.time_contrastive import TimeContrastiveLoss
from vpd_lightning.testing.loss_contract import LossContract
from vpd_lightning.testing.scenes import video_batch
from vpd_lightning.types import SimulatorOutput, VideoBatch

MARGIN = 0.2


def loss_of(previous: torch.Tensor, current: torch.Tensor) -> torch.Tensor:
    output = SimulatorOutput(None, [], {"previous_view_features": previous, "view_features": current})
    return TimeContrastiveLoss(weight=1.0, margin=MARGIN)(output, video_batch(len(previous)))


class TestTimeContrastiveLoss(LossContract):
    def build(self) -> TimeContrastiveLoss:
        return TimeContrastiveLoss(weight=1.0, margin=MARGIN)

    def output(self, batch: VideoBatch) -> SimulatorOutput:
        made = super().output(batch)
        generator = torch.Generator().manual_seed(1)
        names, like = ("previous_view_features", "view_features"), batch.rgbs
        shape = (len(like), 3, 8)
        extra = {name: torch.randn(shape, generator=generator, dtype=torch.float64).to(like) for name in names}
        return SimulatorOutput(made.rendered, made.states, extra)


@pytest.mark.parametrize("num_views", [2, 3, 9])
def test_equals_loops_over_all_triples(num_views: int) -> None:
    generator = torch.Generator().manual_seed(num_views)
    frames = torch.randn(2, 4, num_views, 6, generator=generator, dtype=torch.float64)
    values = []
    for member in range(4):
        for time in (0, 1):
            for view in range(num_views):
                anchor, negative = (frames[t, member, view] / frames[t, member, view].norm() for t in (time, 1 - time))
                for other in range(num_views):
                    if other != view:
                        positive = frames[time, member, other] / frames[time, member, other].norm()
                        distance = ((anchor - positive) ** 2).sum() - ((anchor - negative) ** 2).sum()
                        values.append(max(float(distance) + MARGIN, 0.0))

    assert float(loss_of(*frames)) == pytest.approx(sum(values) / len(values), rel=1e-12)


def test_views_that_agree_and_times_that_differ_cost_nothing_and_the_opposite_does() -> None:
    previous, current = torch.zeros(2, 3, 4), torch.zeros(2, 3, 4)
    previous[..., 0], current[..., 1] = 1.0, 1.0
    assert float(loss_of(previous, current)) == 0.0

    by_view = torch.eye(3, 4).expand(2, 3, 4)  # each view says where it stands, and nothing of the time
    assert float(loss_of(by_view, by_view)) == pytest.approx(2.0 + MARGIN)


def test_gradient_draws_views_together_and_times_apart() -> None:
    features = torch.randn(2, 1, 2, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    features.requires_grad_()
    assert torch.autograd.gradcheck(lambda values: loss_of(values[0], values[1]), features)

    def distances(values: torch.Tensor) -> tuple[float, float]:
        units = torch.nn.functional.normalize(values, dim=-1)
        return float((units[:, :, 0] - units[:, :, 1]).norm()), float((units[0] - units[1]).norm())

    (gradient,) = torch.autograd.grad(loss_of(features[0], features[1]), features)
    before, after = distances(features.detach()), distances(features.detach() - 0.05 * gradient)
    assert after[0] < before[0] and after[1] > before[1]


def test_one_view_and_other_encoders_are_refused_with_a_way_out() -> None:
    with pytest.raises(ConfigError, match="only 1.*\n.*input_views"):
        loss_of(torch.ones(2, 1, 4), torch.ones(2, 1, 4))
    with pytest.raises(ConfigError, match="model=global"):
        TimeContrastiveLoss(weight=1.0, margin=MARGIN)(SimulatorOutput(None, []), video_batch(2))


@pytest.mark.parametrize("wrong", [{"weight": -1.0}, {"margin": 0.0}])
def test_wrong_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="margin must be above 0"):
        TimeContrastiveLoss(**{"weight": 1.0, "margin": MARGIN, **wrong})
