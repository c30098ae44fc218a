"""The compiled nearest point and its twin of matrix products, against all distances in float64."""

import pytest
import torch
from torch import Tensor

from vpd_lightning.dynamics.inertial import nearest
from vpd_lightning.dynamics.inertial.nearest import nearest_usable

BATCH, QUERIES, POINTS = 3, 40, 70


def sets(dtype: torch.dtype, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, Tensor]]:
    draw = torch.Generator().manual_seed(seed)
    queries, points = (torch.rand(BATCH, count, 3, generator=draw, dtype=dtype) for count in (QUERIES, POINTS))
    usable = torch.rand(BATCH, POINTS, generator=draw) < 0.6
    usable[-1] = False
    kinds = tuple(torch.randint(0, 3, (BATCH, count), generator=draw) for count in (QUERIES, POINTS))
    return queries, points, usable, kinds  # type: ignore[return-value]


def expected(queries: Tensor, points: Tensor, usable: Tensor, kinds: tuple[Tensor, Tensor] | None) -> Tensor:
    square = (queries[:, :, None].double() - points[:, None].double()).square().sum(dim=-1)
    counts = usable[:, None].expand(square.shape)
    if kinds is not None:
        counts = counts & (kinds[0][:, :, None] != kinds[1][:, None])
    return square.masked_fill(~counts, torch.inf)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("with_kinds", [False, True])
@pytest.mark.parametrize("is_compiled", [False, True])
def test_it_is_the_nearest(
    monkeypatch: pytest.MonkeyPatch, dtype: torch.dtype, with_kinds: bool, is_compiled: bool
) -> None:
    if not is_compiled:
        monkeypatch.setattr(nearest, "_compiled", lambda: None)
    queries, points, usable, kinds = sets(dtype)
    index, exists = nearest_usable(queries, points, usable, kinds if with_kinds else None)
    square = expected(queries, points, usable, kinds if with_kinds else None)
    assert torch.equal(exists, torch.isfinite(square).any(dim=-1)) and not exists[-1].any()
    assert torch.equal(index[exists], square.argmin(dim=-1)[exists])


@pytest.mark.parametrize("is_compiled", [False, True])
def test_of_equally_far_points_the_first_is_taken(monkeypatch: pytest.MonkeyPatch, is_compiled: bool) -> None:
    if not is_compiled:
        monkeypatch.setattr(nearest, "_compiled", lambda: None)
    points = torch.tensor([[[1.0, 0, 0], [-1, 0, 0], [0, 1, 0]]])
    usable = torch.ones(1, 3, dtype=torch.bool)
    assert nearest_usable(torch.zeros(1, 1, 3), points, usable)[0].item() == 0
    usable[0, 0] = False
    assert nearest_usable(torch.zeros(1, 1, 3), points, usable)[0].item() == 1


def test_a_batch_without_copies_and_no_points_at_all() -> None:
    queries, points, usable, _ = sets(torch.float32)
    many = nearest_usable(queries[:1].expand(5, -1, -1), points[:1].expand(5, -1, -1), usable[:1].expand(5, -1))
    alone = nearest_usable(queries[:1], points[:1], usable[:1])
    assert all(torch.equal(part[4:], one) for part, one in zip(many, alone, strict=True))


def test_the_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    queries, points, usable, kinds = sets(torch.float32)
    plain = nearest_usable(queries, points, usable, kinds)
    monkeypatch.setattr(nearest, "_PAIRS_PER_TASK", 1)
    assert all(torch.equal(*pair) for pair in zip(plain, nearest_usable(queries, points, usable, kinds), strict=True))
