import numpy as np
import pytest
import torch
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from vpd_lightning.dynamics.support import islands, on_ground, within_reach
from vpd_lightning.errors import NonFiniteError

LINK = 0.25


def grid(width, spacing=0.1, height=0.0, at=(0.0, 0.0)):
    line = torch.arange(0, width + 1e-9, spacing, dtype=torch.float64) - width / 2
    x, y = torch.meshgrid(line, line, indexing="ij")
    points = torch.stack([x, y, torch.full_like(x, height)], dim=-1).reshape(-1, 3)
    return points + torch.tensor([*at, 0.0], dtype=torch.float64)


def same_partition(one, other):
    pairs = set(zip(one.tolist(), other.tolist(), strict=True))
    return len(pairs) == len(set(one.tolist())) == len(set(other.tolist()))


@pytest.mark.parametrize("count", [1, 2, 15, 60])
def test_islands_are_those_of_the_complete_distance_matrix(count):
    # Clusters of 5 cm whose centres lie a metre apart on a line, chained within: the cells' blur decides nothing.
    generator = torch.Generator().manual_seed(count)
    cluster = torch.randint(0, 6, (count,), generator=generator)
    points = 0.05 * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    points[:, 0] += cluster

    expected = connected_components(cdist(points.numpy(), points.numpy()) <= LINK, directed=False)[1]

    assert same_partition(islands(points, LINK, "scipy"), torch.from_numpy(expected.astype(np.int64)))


@pytest.mark.parametrize("gap", [0.1, 0.2, 0.31, 0.4])
def test_a_chain_hangs_together_as_long_as_its_gaps_are_links(gap):
    chain = torch.zeros(7, 3, dtype=torch.float64)
    chain[:, 1] = gap * torch.arange(7)

    # Cells are a quarter of a link wide and the gaps no nearer to it than that.
    assert len(islands(chain, LINK, "scipy").unique()) == (1 if gap < LINK else 7)


def test_islands_do_not_depend_on_the_order_of_points_or_the_place_of_the_world():
    points = torch.cat([grid(1.5), grid(0.3, 0.05, 0.7), grid(0.2, 0.05, 1.2)])
    order = torch.randperm(len(points))
    plain = islands(points, LINK, "scipy")

    assert len(plain.unique()) == 3
    assert same_partition(islands(points[order], LINK, "scipy"), plain[order])
    assert same_partition(islands(points + torch.tensor([3.1, -20.0, 0.7]), LINK, "scipy"), plain)


def test_only_what_hangs_together_with_something_wide_is_on_ground():
    floor, resting, flying = grid(2.0), grid(0.3, 0.05, 0.1), grid(0.3, 0.05, 0.6, at=(0.8, 0.8))
    held = on_ground(torch.cat([floor, resting, flying]), LINK, 1.0, "scipy")

    assert held[: len(floor) + len(resting)].all()
    assert not held[len(floor) + len(resting) :].any()


def test_a_second_body_is_held_by_the_one_beneath():
    floor, lower, upper = grid(2.0), grid(0.3, 0.05, 0.2), grid(0.3, 0.05, 0.4)

    assert on_ground(torch.cat([floor, lower, upper]), LINK, 1.0, "scipy").all()
    assert not on_ground(torch.cat([lower, upper]), LINK, 1.0, "scipy").any()


def test_a_ground_of_several_pieces_holds_on_each_that_is_wide():
    # An occluded strip parts the floor; the small piece beyond it is not known to be ground.
    large, small = grid(1.2, at=(0.6, 0.0)), grid(0.3, at=(-0.8, 0.0))
    held = on_ground(torch.cat([large, small]), LINK, 1.0, "scipy")

    assert held[: len(large)].all() and not held[len(large) :].any()


def test_far_apart_huge_and_empty_sets_are_no_trouble():
    far = torch.tensor([[0.0, 0, 0], [1e12, 0, 0], [-1e12, 1e12, 3.0]], dtype=torch.float64)

    assert len(islands(far, LINK, "scipy").unique()) == 3
    assert on_ground(torch.zeros(0, 3), LINK, 1.0, "scipy").shape == (0,)
    with pytest.raises(NonFiniteError):
        islands(torch.tensor([[0.0, float("nan"), 0.0]]), LINK, "scipy")


@pytest.mark.parametrize("num_sources", [0, 1, 30])
def test_within_reach_is_the_smallest_distance_compared(num_sources):
    generator = torch.Generator().manual_seed(1)
    queries = torch.rand(50, 3, generator=generator, dtype=torch.float64)
    sources = torch.rand(num_sources, 3, generator=generator, dtype=torch.float64)

    expected = (cdist(queries.numpy(), sources.numpy()) <= 0.2).any(axis=1)

    assert within_reach(queries, sources, 0.2, "scipy").tolist() == expected.tolist()
