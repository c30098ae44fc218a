from dataclasses import astuple
from importlib.util import find_spec
from itertools import product

import pytest
import torch

from vpd_lightning.errors import NonFiniteError
from vpd_lightning.renderer.kernels.ray_search import RaySearch, check_backend, smallest
from vpd_lightning.renderer.rays.ray_scores import BesideAndBehind, BesideRay

BACKENDS = ["torch", pytest.param("numba", marks=pytest.mark.skipif(not find_spec("numba"), reason="needs numba"))]
SCORES = [BesideRay(0.5, 6.0), BesideRay(2.5, 3.2), BesideAndBehind(0.5, 0.05, 0.3), BesideAndBehind(2.9, 0.2, 0.0)]
PRECISIONS = [torch.float32, torch.float64]


def points(batch=2, count=300, dtype=torch.float64):
    return (torch.rand(batch, count, 3, dtype=torch.float64) * 2 - 1).to(dtype)


def lines(batch=2, count=90, dtype=torch.float64):
    origins = torch.nn.functional.normalize(torch.randn(batch, count, 3, dtype=torch.float64), dim=-1) * 3
    targets = torch.rand(batch, count, 3, dtype=torch.float64) - 0.5
    return origins.to(dtype), torch.nn.functional.normalize(targets - origins, dim=-1).to(dtype)


def scores_by_loop(position, valid, origin, direction, score):
    """Score the particles of one ray one by one in Python floats; infinite where one is left out."""
    o, d = origin.tolist(), direction.tolist()
    pairs = []
    for p, is_valid in zip(position.tolist(), valid.tolist(), strict=True):
        if not is_valid:
            pairs.append((float("inf"), float("inf")))
            continue
        along = sum((p[i] - o[i]) * d[i] for i in range(3))
        pairs.append((along, sum((p[i] - o[i] - along * d[i]) ** 2 for i in range(3))))
    if isinstance(score, BesideRay):
        return [beside if score.near <= along <= score.far else float("inf") for along, beside in pairs]
    pairs = [(along, beside if along >= score.near else float("inf")) for along, beside in pairs]
    first = min(along + 500 / score.width * max(0.0, beside - score.width**2) for along, beside in pairs)
    return [
        float("inf") if beside == float("inf") else beside + 0.04 * max(0.0, along - first - score.depth) ** 2
        for along, beside in pairs
    ]


def assert_best(found, positions, valid, origins, directions, score):
    """Compare with the loop: the scores of what was found must be the smallest there are; each is found once."""
    count = found.index.shape[-1]
    # The products of the brute force lose digits of squared distances of up to 16, in float32 about 1e-6 of each. The
    # first surface moves by up to 1e4 times that where it is judged by the distance beside the ray, and a score by 0.2
    # of it.
    tolerance = (1e-5 if positions.dtype == torch.float32 else 1e-13) * (
        200 if isinstance(score, BesideAndBehind) else 1
    )
    for member, ray in product(range(len(positions)), range(origins.shape[1])):
        every = torch.tensor(
            scores_by_loop(positions[member], valid[member], origins[member, ray], directions[member, ray], score),
            dtype=torch.float64,
        )
        index = found.index[member, ray][found.mask[member, ray]]
        assert len(set(index.tolist())) == len(index) == min(count, int((every < torch.inf).sum()))
        torch.testing.assert_close(
            every[index].sort().values, every.sort().values[: len(index)], rtol=1e-6, atol=tolerance
        )


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("score", SCORES)
@pytest.mark.parametrize("backend", BACKENDS)
def test_what_is_found_has_the_smallest_scores(backend, score, dtype):
    positions, (origins, directions) = points(dtype=dtype), lines(dtype=dtype)
    valid = torch.rand(2, 300) > 0.2

    found = RaySearch(positions, valid, backend).closest(origins, directions, 9, score)

    assert_best(found, positions, valid, origins, directions, score)


@pytest.mark.parametrize("count", [0, 1, 8, 15, 16, 17, 256, 257])
@pytest.mark.parametrize("score", [SCORES[0], SCORES[2]])
@pytest.mark.parametrize("backend", BACKENDS)
def test_any_number_of_particles_will_do(backend, score, count):
    positions, (origins, directions) = points(count=count), lines(count=5)
    valid = torch.ones(2, count, dtype=torch.bool)
    valid[1] = False

    found = RaySearch(positions, valid, backend).closest(origins, directions, 9, score)

    assert found.index.shape == found.mask.shape == (2, 5, 9)
    assert not found.mask[1].any() and not found.index[~found.mask].any()
    if count:
        assert_best(found, positions[:1], valid[:1], origins[:1], directions[:1], score)


@pytest.mark.parametrize("backend", BACKENDS)
def test_cameras_among_the_particles_see_only_what_is_before_them(backend):
    positions, (origins, directions) = points(), lines()
    origins = 0.2 * origins
    valid = torch.ones(2, 300, dtype=torch.bool)
    for score in (BesideRay(0.1, 0.9), BesideAndBehind(0.1, 0.1, 0.3)):
        found = RaySearch(positions, valid, backend).closest(origins, directions, 24, score)
        assert_best(found, positions, valid, origins, directions, score)


@pytest.mark.parametrize("backend", BACKENDS)
def test_padding_may_hold_anything_and_is_never_found(backend):
    positions, (origins, directions) = points(), lines()
    valid = torch.rand(2, 300) > 0.5
    spoiled = torch.where(valid[..., None], positions, torch.nan)
    for score in SCORES:
        found = RaySearch(spoiled, valid, backend).closest(origins, directions, 9, score)
        assert valid[torch.arange(2)[:, None, None], found.index][found.mask].all()


@pytest.mark.skipif(not find_spec("numba"), reason="needs numba")
@pytest.mark.parametrize("score", SCORES)
def test_compiled_search_depends_neither_on_threads_nor_on_other_rays(score):
    positions, (origins, directions) = points(count=500, dtype=torch.float32), lines(count=200, dtype=torch.float32)
    positions[:, 100:200] = positions[:, :1]  # ties: the same ones must win
    search = RaySearch(positions, torch.ones(2, 500, dtype=torch.bool), "numba")
    alone = search.closest(origins, directions, 24, score)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        together = search.closest(origins, directions, 24, score)
    finally:
        torch.set_num_threads(threads)
    some = search.closest(origins[:, 90:99], directions[:, 90:99], 24, score)

    assert torch.equal(alone.index, together.index) and torch.equal(alone.mask, together.mask)
    assert torch.equal(alone.index[:, 90:99], some.index)


@pytest.mark.parametrize("score", SCORES)
@pytest.mark.parametrize("scale", [1e-6, 1e6])
@pytest.mark.parametrize("backend", BACKENDS)
def test_small_and_large_worlds(backend, scale, score):
    positions, (origins, directions) = scale * points(), lines()
    valid = torch.ones(2, 300, dtype=torch.bool)
    scaled = type(score)(*(scale * length for length in astuple(score)))

    found = RaySearch(positions, valid, backend).closest(scale * origins, directions, 9, scaled)
    same = RaySearch(positions / scale, valid, backend).closest(origins, directions, 9, score)

    assert torch.equal(found.index.sort(dim=-1).values, same.index.sort(dim=-1).values)


@pytest.mark.parametrize("backend", BACKENDS)
def test_thousands_of_duplicates_are_found_once_each(backend):
    positions = points(batch=1, count=1).expand(1, 3000, 3).contiguous()
    origins, directions = lines(batch=1, count=20)
    found = RaySearch(positions, torch.ones(1, 3000, dtype=torch.bool), backend).closest(
        origins, directions, 24, BesideRay(0.0, 10.0)
    )

    assert found.mask.all() and all(len(set(row.tolist())) == 24 for row in found.index[0])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_is_refused(backend, value):
    positions, (origins, directions) = points(), lines()
    valid = torch.ones(2, 300, dtype=torch.bool)
    search = RaySearch(positions, valid, backend)
    positions[1, 7, 2] = directions[0, 3, 1] = value

    with pytest.raises(NonFiniteError):
        search.closest(origins, directions, 9, SCORES[0])
    with pytest.raises(NonFiniteError):
        RaySearch(positions, valid, backend)


def test_an_unknown_backend_is_refused_by_name():
    with pytest.raises(ValueError, match="candidate_backend"):
        check_backend("cuda")


@pytest.mark.parametrize(("num_particles", "count"), [(5, 8), (130, 8), (131, 8), (1280, 24), (1281, 24)])
def test_grouped_selection_finds_the_smallest_scores(num_particles, count):
    scores = torch.rand(33, num_particles).round(decimals=2)  # with ties

    index = smallest(scores, count)

    expected = scores.sort(dim=-1).values[:, :count]
    assert torch.equal(torch.gather(scores, 1, index).sort(dim=-1).values, expected)
    assert all(len(set(row.tolist())) == len(row) for row in index)
