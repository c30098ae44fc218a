import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from vpd_lightning.errors import NonFiniteError, VPDError
from vpd_lightning.graph.neighbors import BACKENDS, PointIndex, knn, radius

# Triton searches on a GPU or in its interpreter: see test_neighbors_triton.py.
ALL_BACKENDS = [
    pytest.param(name, marks=pytest.mark.cluster) if name == "torch_cluster" else name
    for name in (*BACKENDS, "auto")
    if name != "triton"
]
SIZES = [0, 1, 15, 16, 17, 63, 1000]


def cloud(count: int, dtype: torch.dtype = torch.float64, duplicates: bool = False) -> torch.Tensor:
    points = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(count)) * 2 - 1
    if duplicates and count > 3:
        points[count // 2 :] = points[: count - count // 2].clone()
    return points.to(dtype)


def sorted_distances(points: torch.Tensor, queries: torch.Tensor, k: int) -> np.ndarray:
    """All distances in NumPy, the k smallest of each query, padded with infinity."""
    distances = np.linalg.norm(queries.double().numpy()[:, None] - points.double().numpy()[None], axis=-1)
    distances = np.sort(distances, axis=1)[:, :k]
    return np.pad(distances, ((0, 0), (0, k - distances.shape[1])), constant_values=np.inf)


@pytest.mark.parametrize("duplicates", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_knn_finds_the_smallest_distances(backend: str, count: int, dtype: torch.dtype, duplicates: bool) -> None:
    points, queries = cloud(count, dtype, duplicates), cloud(50, dtype)
    neighbors = knn(points, queries, 16, backend=backend)
    expected = sorted_distances(points, queries, 16)
    assert neighbors.distance.dtype == dtype
    assert neighbors.index.shape == neighbors.distance.shape == neighbors.mask.shape == (50, 16)
    # One subtraction, one square and one root in float32 lose a few units in the last place.
    torch.testing.assert_close(
        neighbors.distance.double(), torch.from_numpy(expected), rtol=1e-12 if dtype == torch.float64 else 1e-5, atol=0
    )
    assert torch.equal(neighbors.mask.sum(dim=1), torch.full((50,), min(count, 16)))
    assert bool((neighbors.index[~neighbors.mask] == 0).all())
    assert bool(torch.isinf(neighbors.distance[~neighbors.mask]).all())
    if count:
        again = (points[neighbors.index] - queries[:, None]).norm(dim=-1)
        torch.testing.assert_close(again[neighbors.mask], neighbors.distance[neighbors.mask])
        for row, mask in zip(neighbors.index, neighbors.mask, strict=True):
            assert len(set(row[mask].tolist())) == int(mask.sum())


@pytest.mark.parametrize("count", SIZES[1:])
def test_brute_force_agrees_with_scipy(count: int) -> None:
    points, queries = cloud(count), cloud(50)
    expected, _ = cKDTree(points.numpy()).query(queries.numpy(), k=list(range(1, 9)))
    torch.testing.assert_close(
        knn(points, queries, 8, backend="torch").distance, torch.from_numpy(expected), rtol=1e-12, atol=0
    )


@pytest.mark.parametrize("k", [1, 2, 4, 5, 16])
def test_the_reference_breaks_ties_by_index(k: int) -> None:
    grid = torch.cartesian_prod(*[torch.arange(4.0)] * 3)
    queries = torch.cat([grid, grid + 0.5])
    neighbors = knn(grid, queries, k, backend="torch")
    squared = (grid[None] - queries[:, None]).square().sum(dim=-1)
    expected = torch.stack([row.sort(stable=True).indices[:k] for row in squared])
    assert torch.equal(neighbors.index, expected)


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_the_radius_is_inclusive_and_masks_the_rest(backend: str) -> None:
    points = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [0, 0.75, 0], [0, 0, 2]])
    neighbors = knn(points, torch.zeros(1, 3), 4, max_radius=0.5, backend=backend)
    assert neighbors.mask.tolist() == [[True, True, False, False]]
    assert neighbors.index.tolist() == [[0, 1, 0, 0]]
    assert neighbors.distance.tolist() == [[0.0, 0.5, torch.inf, torch.inf]]
    senders, receivers = radius(points, torch.zeros(1, 3), 0.75, backend=backend)
    assert senders.tolist() == [0, 1, 2] and receivers.tolist() == [0, 0, 0]


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_radius_is_complete_and_sorted_by_receiver_then_sender(backend: str, count: int) -> None:
    points, queries = cloud(count, duplicates=True), cloud(40)
    senders, receivers = radius(points, queries, 0.6, backend=backend)
    distances = np.linalg.norm(queries.numpy()[:, None] - points.numpy()[None], axis=-1)
    expected_receivers, expected_senders = np.nonzero(distances <= 0.6)
    assert senders.tolist() == expected_senders.tolist()
    assert receivers.tolist() == expected_receivers.tolist()


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_no_queries_give_an_empty_table(backend: str) -> None:
    neighbors = knn(cloud(20), torch.zeros(0, 3, dtype=torch.float64), 16, backend=backend)
    assert neighbors.index.shape == (0, 16)
    assert all(len(side) == 0 for side in radius(cloud(20), torch.zeros(0, 3, dtype=torch.float64), 1.0, backend))


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_non_finite_input_is_refused_by_name(backend: str, bad: float) -> None:
    clean, broken = cloud(20), cloud(20)
    broken[3, 1] = bad
    with pytest.raises(NonFiniteError, match=r"1 of 20 points") as caught:
        knn(broken, clean, 2, backend=backend)
    assert isinstance(caught.value, VPDError) and len(str(caught.value).splitlines()) <= 5
    with pytest.raises(NonFiniteError, match=r"1 of 20 queries"):
        knn(clean, broken, 2, backend=backend)
    with pytest.raises(NonFiniteError, match=r"points"):
        radius(broken, clean, 1.0, backend=backend)


def test_distances_far_from_the_origin_keep_their_digits() -> None:
    points = cloud(200, torch.float32) + torch.tensor([1000.0, -2000.0, 500.0])
    for backend in ("torch", "scipy"):
        neighbors = knn(points, points[:20], 3, backend=backend)
        expected = sorted_distances(points, points[:20], 3)
        torch.testing.assert_close(neighbors.distance.double(), torch.from_numpy(expected), rtol=1e-5, atol=0)
        assert torch.equal(neighbors.index[:, 0], torch.arange(20))


def test_one_index_serves_many_searches() -> None:
    points = cloud(100)
    for backend in ("torch", "scipy"):
        index = PointIndex(points, backend)
        for seed in range(3):
            queries = cloud(10 + seed)
            torch.testing.assert_close(
                index.knn(queries, 5).distance, knn(points, queries, 5, backend="torch").distance, rtol=1e-12, atol=0
            )


def test_results_carry_no_gradient() -> None:
    points = cloud(30).requires_grad_()
    assert not knn(points, points, 4).distance.requires_grad


def test_unknown_backends_and_negative_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="backend"):
        knn(cloud(3), cloud(3), 1, backend="faiss")
    with pytest.raises(ValueError, match="k must"):
        knn(cloud(3), cloud(3), -1)
    with pytest.raises(ValueError, match="max_radius"):
        radius(cloud(3), cloud(3), -0.1)


@pytest.mark.gpu
@pytest.mark.parametrize("backend", [*ALL_BACKENDS, "triton"])
def test_cuda_tensors_give_the_same_distances(backend: str) -> None:
    points, queries = cloud(500, torch.float32), cloud(70, torch.float32)
    neighbors = knn(points.cuda(), queries.cuda(), 16, 0.5, backend)
    expected = knn(points, queries, 16, 0.5, "torch")
    assert neighbors.distance.is_cuda
    torch.testing.assert_close(neighbors.distance.cpu(), expected.distance, rtol=1e-5, atol=0)
