"""Chamfer distance against an all-pairs computation."""

import math

import pytest
import torch

from vpd_lightning.metrics.chamfer import chamfer


def test_chamfer_equals_all_pairs() -> None:
    generator = torch.Generator().manual_seed(0)
    pred, target = torch.randn(40, 3, generator=generator), torch.randn(60, 3, generator=generator)
    distances = (pred.double()[:, None] - target.double()[None]).norm(dim=-1)
    result = chamfer(pred, target)
    assert result.accuracy == pytest.approx(distances.min(1).values.mean().item(), abs=1e-9)
    assert result.completeness == pytest.approx(distances.min(0).values.mean().item(), abs=1e-9)
    assert result.mean == pytest.approx((result.accuracy + result.completeness) / 2)


def test_chamfer_of_a_set_with_its_permutation_is_zero() -> None:
    points = torch.rand(30, 3)
    assert chamfer(points, points.flip(0)).mean == 0.0


def test_chamfer_with_nothing_is_missing() -> None:
    assert math.isnan(chamfer(torch.zeros(0, 3), torch.zeros(5, 3)).mean)
