"""The compiled search: equal to brute force to the last bit, whatever the numbers, the order and the threads."""

from collections.abc import Iterator

import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from vpd_lightning.graph.neighbors import Neighbors, PointIndex, knn, radius

pytest.importorskip("numba")
from vpd_lightning.graph.neighbors import numba_blocks  # noqa: E402


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def surface(count: int, seed: int = 0) -> Tensor:
    """Half on a floor, half on a sphere: float32, in random order."""
    floor = torch.rand(count, 3, generator=generator(seed)) * 2 - 1
    floor[:, 2] = 0
    sphere = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator(seed + 1)), dim=1) * 0.3
    return torch.where(torch.arange(count)[:, None] % 2 == 0, floor, sphere)


def ray_samples(rays: int, samples: int, seed: int = 0) -> Tensor:
    start = torch.randn(rays, 1, 3, generator=generator(seed)) * 2
    end = torch.rand(rays, 1, 3, generator=generator(seed + 1)) * 2 - 1
    return (start + (end - start) * torch.linspace(0, 2, samples)[:, None]).reshape(-1, 3)


def assert_same(found: Neighbors, expected: Neighbors) -> None:
    assert torch.equal(found.distance, expected.distance)
    assert torch.equal(found.index, expected.index)
    assert torch.equal(found.mask, expected.mask)


CASES = {
    "along rays": (surface(2000), ray_samples(20, 60)),
    "in random order": (surface(2000), surface(1000, 5)),
    "every point its own query": (surface(700), surface(700)),
    "all octants": (torch.randn(900, 3, generator=generator(3)), torch.randn(300, 3, generator=generator(4))),
    "all negative": (surface(500) - 10, ray_samples(10, 30) - 10),
    "far from the origin": (surface(500) + 1e4, ray_samples(10, 30) + 1e4),
    "tiny": (surface(500) * 1e-6, ray_samples(10, 30) * 1e-6),
    "huge": (surface(500) * 1e6, ray_samples(10, 30) * 1e6),
    "squares are denormal": (surface(500) * 1e-21, ray_samples(10, 30) * 1e-21),
    "coordinates are denormal": (surface(500) * 1e-40, ray_samples(10, 30) * 1e-40),
    "squares overflow": (surface(500) * 1e25, ray_samples(10, 30) * 1e25),
    "thousands of duplicates": (surface(3).repeat(1500, 1), ray_samples(4, 30)),
    "all in one place": (torch.ones(2000, 3), torch.ones(50, 3)),
    "all queries equal": (surface(1000), torch.ones(200, 3) * 0.1),
    # Half of the distances are ties, and points lie on faces of boxes.
    "on a grid": (
        torch.cartesian_prod(*[torch.arange(-5.0, 6)] * 3),
        torch.cartesian_prod(*[torch.arange(-4.0, 4)] * 3) / 2,
    ),
    "on a line": (torch.tensor([[1.0, 0, 0]]) * torch.arange(1000)[:, None], ray_samples(10, 30) * 100),
}


@pytest.mark.parametrize("max_radius", [None, 0.25])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("case", CASES)
def test_it_equals_brute_force_bit_for_bit_with_ties_by_index(
    case: str, dtype: torch.dtype, max_radius: float | None
) -> None:
    points, queries = (side.to(dtype) for side in CASES[case])
    for k in (1, 2, 16):
        assert_same(knn(points, queries, k, max_radius, "numba"), knn(points, queries, k, max_radius, "torch"))


@pytest.mark.parametrize("count", [1, 15, 16, 17, 31, 32, 33, 511, 512, 513, 8193])
def test_odd_sizes_up_to_three_levels_of_boxes(count: int) -> None:
    points, queries = surface(count), ray_samples(5, 17)
    assert_same(knn(points, queries, 16, backend="numba"), knn(points, queries, 16, backend="torch"))


@pytest.mark.parametrize("k", [0, 3, 16, 17, 40, 300])
def test_more_neighbors_than_points(k: int) -> None:
    points, queries = surface(40), ray_samples(3, 20)
    assert_same(knn(points, queries, k, backend="numba"), knn(points, queries, k, backend="torch"))


def test_distances_are_those_of_scipy() -> None:
    points, queries = surface(5000).double(), ray_samples(20, 50).double()
    expected, _ = cKDTree(points.numpy()).query(queries.numpy(), k=16)
    # Both work in float64; the sums may round differently in the last place.
    found = knn(points, queries, 16, backend="numba").distance
    torch.testing.assert_close(found, torch.from_numpy(expected), rtol=1e-14, atol=0)


def test_points_on_the_faces_of_boxes_with_queries_one_bit_away() -> None:
    """A distance to a box, as rounded, must not exceed that of a point on its face, or the point is lost."""
    points = torch.rand(3000, 3, generator=generator(0)).mul(64).round() / 64 * 3.3
    up = torch.nextafter(points, torch.tensor(torch.inf))
    down = torch.nextafter(points, torch.tensor(-torch.inf))
    queries = torch.cat([points, up, down, -up])[::7]
    assert_same(knn(points, queries, 8, backend="numba"), knn(points, queries, 8, backend="torch"))


def test_the_radius_decides_to_the_last_bit() -> None:
    """Distances that equal the radius as rounded are in, those one step above it are out, in both searches."""
    points, queries = surface(600), ray_samples(6, 40)
    for dtype in (torch.float32, torch.float64):
        ours, theirs = points.to(dtype), queries.to(dtype)
        distances = knn(ours, theirs, 8, backend="torch").distance.flatten()
        for distance in distances[torch.randperm(len(distances), generator=generator(1))[:20]]:
            below = torch.nextafter(distance, torch.zeros((), dtype=dtype))
            for bound in (distance.item(), below.item()):
                assert_same(knn(ours, theirs, 8, bound, "numba"), knn(ours, theirs, 8, bound, "torch"))
                for found, expected in zip(
                    radius(ours, theirs, bound, "numba"), radius(ours, theirs, bound, "torch"), strict=True
                ):
                    assert torch.equal(found, expected)


@pytest.mark.parametrize("bound", [0.0, 1e-30, 1e30, float("inf")])
def test_extreme_radii(bound: float) -> None:
    points, queries = surface(200), torch.cat([surface(200)[:20], ray_samples(2, 10)])
    assert_same(knn(points, queries, 4, bound, "numba"), knn(points, queries, 4, bound, "torch"))
    for found, expected in zip(
        radius(points, queries, bound, "numba"), radius(points, queries, bound, "torch"), strict=True
    ):
        assert torch.equal(found, expected)


@pytest.fixture
def _threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("_threads")
def test_neither_threads_nor_slices_nor_the_order_of_queries_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    points, queries = surface(1000), ray_samples(15, 40)
    index = PointIndex(points, "numba")
    torch.set_num_threads(1)
    expected, expected_pairs = index.knn(queries, 16), index.radius(queries, 0.3)
    monkeypatch.setattr(numba_blocks, "_QUERIES_PER_SLICE", 37)
    torch.set_num_threads(3)
    assert_same(index.knn(queries, 16), expected)
    assert all(map(torch.equal, index.radius(queries, 0.3), expected_pairs))
    shuffled = torch.randperm(len(queries), generator=generator(2))
    found = index.knn(queries[shuffled], 16)
    assert torch.equal(found.index, expected.index[shuffled])
    assert torch.equal(found.distance, expected.distance[shuffled])


def test_slices_of_memory_that_are_not_contiguous() -> None:
    wide = torch.rand(500, 7, generator=generator(0))
    points, queries = wide[:, 1:4], wide.t()[3:6, ::3].t()
    assert not points.is_contiguous() and not queries.is_contiguous()
    assert_same(
        knn(points, queries, 5, backend="numba"), knn(points.contiguous(), queries.contiguous(), 5, backend="torch")
    )


def test_half_precision_is_measured_as_it_came() -> None:
    points, queries = surface(300).bfloat16(), ray_samples(3, 20).bfloat16()
    found = knn(points, queries, 4, backend="numba")
    again = (points[found.index] - queries[:, None]).norm(dim=-1)
    assert found.distance.dtype == torch.bfloat16
    # Three bfloat16 roundings of 2^-9 each.
    torch.testing.assert_close(found.distance, again, rtol=2e-2, atol=0)
