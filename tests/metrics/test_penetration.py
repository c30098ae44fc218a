"""Depth below a floor and in turned boxes, in closed form."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from vpd_lightning.metrics.penetration import below_floor, deepest, inside_box_depth


def test_depth_below_the_floor_is_never_negative() -> None:
    points = torch.tensor([[5.0, 5.0, 0.2], [0.0, 0.0, -0.3]])
    torch.testing.assert_close(below_floor(points, height=-0.1), torch.tensor([0.0, 0.2]))
    assert below_floor(points, height=float("nan")).isnan().all()


def test_depth_in_a_turned_box_is_the_distance_to_the_nearest_face() -> None:
    random = np.random.default_rng(0)
    half, center, rotation = np.array([0.5, 0.3, 0.1]), np.array([1.0, -2.0, 0.5]), Rotation.random(rng=3)
    local = random.uniform(-1, 1, (500, 3)) * half * 1.5
    expected = np.maximum((half - abs(local)).min(axis=1), 0)
    pose = torch.tensor(np.concatenate([center, np.roll(rotation.as_quat(), 1)]))
    still = pose.clone()
    still[0] += 10.0
    points = torch.tensor(rotation.apply(local) + center)
    depth = inside_box_depth(points.expand(2, -1, -1), torch.stack([pose, still]), torch.tensor(half))
    np.testing.assert_allclose(depth[0].numpy(), expected, atol=1e-12)
    assert 0.02 < (depth[0] > 0).double().mean() < 0.9 and (depth[1] == 0).all()


def test_the_deepest_of_none_is_no_depth() -> None:
    assert deepest(torch.zeros(4, 0)).tolist() == [0.0] * 4
    assert deepest(torch.tensor([[0.0, 0.2, 0.1]])).item() == pytest.approx(0.2)
