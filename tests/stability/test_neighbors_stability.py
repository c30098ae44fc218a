"""Neighbour search on hard point sets: every backend gives the distances that float64 brute force gives."""

import pytest
import torch
from torch import Tensor

from tests.stability.backends import IS_INTERPRETED, require_route, routes
from tests.stability.hard_scenes import MODES, SCENES, HardScene, Mode, cloud, is_finite, samples
from vpd_lightning.errors import NonFiniteError
from vpd_lightning.graph.neighbors import BACKENDS, PointIndex, knn, radius


@pytest.fixture(params=routes("auto", *BACKENDS))
def route(request: pytest.FixtureRequest) -> tuple[str, str]:
    require_route(request.param[0])
    return request.param


@pytest.fixture
def backend(route: tuple[str, str]) -> str:
    return route[0]


@pytest.fixture
def device(route: tuple[str, str]) -> torch.device:
    return torch.device(route[1])


# The interpreter is slow, and a search does the same with and without autocast.
MODES_HERE = [mode for mode in MODES if not (IS_INTERPRETED and mode.is_autocast)]


@pytest.fixture(params=MODES_HERE, ids=lambda mode: mode.name)
def mode(request: pytest.FixtureRequest) -> Mode:
    return request.param


def exact_distances(scene: HardScene) -> Tensor:
    """Return all distances (query, point) in float64 from the coordinates as they were rounded."""
    return (scene.queries.double()[:, None] - scene.points.double()).norm(dim=-1)


def tolerances(mode: Mode) -> dict[str, float]:
    # A difference of two given numbers, its square, the sum and the root are each rounded once: less than 4 eps.
    # Squares of differences below the smallest normal root lose digits, whatever is done.
    return {"rtol": 4 * mode.eps, "atol": mode.smallest_distance}


@pytest.mark.parametrize("k", [16] if IS_INTERPRETED else [1, 16])
def test_nearest_distances_are_those_of_float64(
    scene: HardScene, mode: Mode, backend: str, device: torch.device, k: int
):
    scene = scene.to(mode, device)

    with mode.context(device):
        found = knn(scene.points, scene.queries, k, backend=backend)

    exact = exact_distances(scene)
    count = min(k, len(scene.points))
    assert found.index.shape == found.mask.shape == (len(scene.queries), k)
    assert found.mask[:, :count].all() and not found.mask[:, count:].any()
    assert (found.index[~found.mask] == 0).all() and (found.distance[~found.mask] == torch.inf).all()
    assert found.distance.dtype == mode.dtype
    torch.testing.assert_close(
        found.distance[:, :count].double(), exact.sort(dim=1).values[:, :count], **tolerances(mode)
    )
    # The indices belong to the distances, and none comes twice.
    at_index = exact.gather(1, found.index[:, :count]) if count else exact[:, :0]
    torch.testing.assert_close(found.distance[:, :count].double(), at_index, **tolerances(mode))
    assert all(len(set(row.tolist())) == count for row in found.index[:, :count])


@pytest.mark.parametrize("reach", [0.0, 1.5])
def test_bounded_search_and_radius_agree_with_float64(
    scene: HardScene, mode: Mode, backend: str, device: torch.device, reach: float
):
    scene, bound = scene.to(mode, device), reach * scene.spacing

    with mode.context(device):
        senders, receivers = radius(scene.points, scene.queries, bound, backend=backend)
        found = knn(scene.points, scene.queries, 16, max_radius=bound, backend=backend)

    exact = exact_distances(scene)
    close = torch.zeros_like(exact, dtype=torch.bool)
    close[receivers, senders] = True
    slack = 4 * mode.eps * bound + mode.smallest_distance
    assert close[exact <= bound - slack].all() and not close[exact > bound + slack].any()
    # Each bounded list is as long as the radius search says, up to 16, and nothing beyond the bound is in it.
    surely, at_most = (exact <= bound - slack).sum(dim=1), (exact <= bound + slack).sum(dim=1)
    length = found.mask.sum(dim=1)
    assert (length >= surely.clamp(max=16)).all() and (length <= at_most.clamp(max=16)).all()
    assert (found.distance[found.mask] <= bound).all() and (found.distance[~found.mask] == torch.inf).all()


@pytest.mark.parametrize("shift", [1e3, 1e6])
def test_a_translated_world_has_the_same_neighbors(mode: Mode, backend: str, device: torch.device, shift: float):
    # Coordinates on a grid of 1/8 m are exact in float32 up to 2^21 m, so nothing may change at all.
    generator = torch.Generator().manual_seed(2)
    points = (torch.randint(-8, 8, (60, 3), generator=generator) / 8).to(device, mode.dtype)
    queries = (torch.randint(-8, 8, (30, 3), generator=generator) / 8).to(device, mode.dtype)

    here = knn(points, queries, 16, backend=backend)
    there = knn(points + shift, queries + shift, 16, backend=backend)

    torch.testing.assert_close(there.distance, here.distance, rtol=0.0, atol=0.0)


def test_the_order_of_points_does_not_matter(scene: HardScene, mode: Mode, backend: str, device: torch.device):
    scene = scene.to(mode, device)
    order = torch.randperm(len(scene.points), generator=torch.Generator().manual_seed(3)).to(device)

    found = knn(scene.points, scene.queries, 16, backend=backend)
    again = knn(scene.points[order], scene.queries, 16, backend=backend)

    # Sums are taken within one pair, in a fixed order, so distances keep every bit.
    torch.testing.assert_close(again.distance, found.distance, rtol=0.0, atol=0.0)


@pytest.mark.parametrize("name", ["ordinary", "thousands_of_duplicates", "lattice_of_ties"])
def test_a_search_repeats_bit_for_bit(name: str, mode: Mode, backend: str, device: torch.device):
    scene = SCENES[name]().to(mode, device)

    first, second = (PointIndex(scene.points, backend).knn(scene.queries, 16) for _ in range(2))

    assert torch.equal(first.index, second.index) and torch.equal(first.distance, second.distance)


@pytest.mark.skipif(IS_INTERPRETED, reason="one thread is slow enough there")
def test_the_number_of_threads_changes_nothing(mode: Mode, backend: str, device: torch.device):
    points = cloud(500).to(device, mode.dtype)
    queries = samples(20_000).to(device, mode.dtype)  # more than one thread takes at a time

    found = []
    for num_threads in (1, 3):
        torch.set_num_threads(num_threads)
        try:
            found.append(knn(points, queries, 4, backend=backend))
        finally:
            torch.set_num_threads(1)

    assert torch.equal(found[0].index, found[1].index) and torch.equal(found[0].distance, found[1].distance)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("where", ["points", "queries"])
def test_numbers_that_are_not_finite_are_refused_by_name(where: str, value: float, backend: str, device: torch.device):
    scene = SCENES["ordinary"]()
    inputs = {"points": scene.points.to(device).clone(), "queries": scene.queries.to(device).clone()}
    inputs[where][7, 1] = value

    is_triton = PointIndex(inputs["points"], backend).backend == "triton" if where == "queries" else backend == "triton"
    if is_triton:  # it never waits for the device, so it spoils what is computed from its answer instead
        distance = knn(**inputs, k=4, backend=backend).distance
        assert distance[7].isnan().all() and (where == "queries" or distance.isnan().all())
    else:
        with pytest.raises(NonFiniteError, match=f"1 of .* {where}"):
            knn(**inputs, k=4, backend=backend)
    with pytest.raises(NonFiniteError, match=f"1 of .* {where}"):
        radius(**inputs, max_radius=0.2, backend=backend)


def test_coordinates_whose_squares_overflow_are_not_neighbors(backend: str, device: torch.device):
    # 1e20 is a float32, its square is not: such a point is as good as not there, and nothing is NaN.
    points = torch.tensor([[0.0, 0.0, 0.0], [1e20, 0.0, 0.0], [0.1, 0.0, 0.0]], device=device)

    found = knn(points, torch.zeros(1, 3, device=device), 3, backend=backend)

    assert found.mask.tolist() == [[True, True, False]] and found.index.tolist() == [[0, 2, 0]]
    assert is_finite(found.distance[found.mask])
