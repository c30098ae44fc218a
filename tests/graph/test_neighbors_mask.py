"""A mask over the points: what lies outside is never found and may hold anything."""

import pytest
import torch

from vpd_lightning.errors import NonFiniteError
from vpd_lightning.graph.neighbors import BACKENDS, PointIndex

BACKENDS_HERE = [
    pytest.param(name, marks=pytest.mark.cluster) if name == "torch_cluster" else name
    for name in (*BACKENDS, "auto")
    if name != "triton"
]


@pytest.mark.parametrize("backend", BACKENDS_HERE)
@pytest.mark.parametrize("kept", [0, 1, 5, 99, 100])
def test_a_mask_equals_searching_in_the_points_inside_it(backend: str, kept: int) -> None:
    points, queries = torch.rand(100, 3), torch.rand(30, 3)
    mask = torch.zeros(100, dtype=torch.bool)
    mask[torch.randperm(100)[:kept]] = True
    original = mask.nonzero()[:, 0]
    points[~mask] = torch.nan
    index = PointIndex(points, backend, mask=mask)
    inside = PointIndex(points[mask], "torch")
    found, expected = index.knn(queries, 8, 0.9), inside.knn(queries, 8, 0.9)
    assert torch.equal(found.mask, expected.mask)
    assert torch.equal(found.distance, expected.distance)
    assert torch.equal(found.index[found.mask], original[expected.index[expected.mask]])
    assert not bool(found.index[~found.mask].any())
    senders, receivers = index.radius(queries, 0.4)
    expected_senders, expected_receivers = inside.radius(queries, 0.4)
    assert torch.equal(senders, original[expected_senders]) and torch.equal(receivers, expected_receivers)


def test_what_is_inside_the_mask_must_be_finite() -> None:
    points, mask = torch.rand(10, 3), torch.ones(10, dtype=torch.bool)
    points[4, 1] = torch.inf
    with pytest.raises(NonFiniteError, match="1 of 10 points"):
        PointIndex(points, "torch", mask=mask)
