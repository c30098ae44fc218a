"""Soft matches and the spacing of points against loops."""

from dataclasses import replace

import pytest
import torch

from tests.dynamics.test_first_velocity import surfels
from vpd_lightning.dynamics.inertial.first_velocity import match, match_confidence
from vpd_lightning.geometry.spacing import point_spacing


def test_the_best_match_of_a_point_is_the_nearest_of_its_colour():
    generator = torch.Generator().manual_seed(3)
    at = torch.rand(1, 7, 3, generator=generator, dtype=torch.float64)
    target = surfels(*(torch.rand(11, 3, generator=generator, dtype=torch.float64) for _ in range(3)))
    cost = torch.rand(1, 7, 11, generator=generator, dtype=torch.float64)
    scales = 0.1 + torch.rand(1, 7, generator=generator, dtype=torch.float64)
    target = replace(target, mask=torch.arange(11)[None] != 4)

    matched, evidence, shares = match(at, target, cost, scales)

    for point in range(7):
        weights = {}
        for other in (number for number in range(11) if number != 4):
            square = float(((at[0, point] - target.positions[0, other]) ** 2).sum())
            weights[other] = float(torch.exp(-square / (2 * scales[0, point] ** 2) - cost[0, point, other]))
        total = sum(weights.values())
        mean = sum(weight * target.positions[0, other] for other, weight in weights.items()) / total
        assert shares[0, point].argmax().item() == max(weights, key=weights.get)
        assert torch.allclose(matched[0, point], mean, atol=1e-12)
        assert evidence[0, point].item() == pytest.approx(total, rel=1e-12)


def test_confidence_grows_from_zero_towards_one():
    evidence = torch.tensor([0.0, 0.3, 1.0, 1e6])
    assert torch.allclose(match_confidence(evidence), torch.tensor([0.0, 0.5, 1 / 1.3, 1.0]), atol=1e-6)


def test_spacing_is_the_median_distance_to_the_fourth_nearest():
    grid = torch.cartesian_prod(*[torch.arange(5, dtype=torch.float64)] * 2)
    points = torch.cat([grid, torch.zeros(25, 1, dtype=torch.float64)], dim=1)[None] * 0.1
    mask = torch.ones(1, 25, dtype=torch.bool)
    square = (points[0, :, None] - points[0]).square().sum(-1).sqrt()
    fourth = square.sort(dim=1).values[:, 4].sort().values[12]

    assert point_spacing(points, mask).item() == pytest.approx(fourth.item())
    assert point_spacing(points, torch.zeros_like(mask)).item() == 0
    far_padding = torch.cat([points, torch.full((1, 9, 3), 1e3).double()], dim=1)
    padded = torch.cat([mask, torch.zeros(1, 9, dtype=torch.bool)], dim=1)
    assert point_spacing(far_padding, padded).item() == pytest.approx(fourth.item())
