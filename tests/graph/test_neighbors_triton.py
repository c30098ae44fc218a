"""The GPU search: in Triton's interpreter (a process of its own, in which Triton starts as such) and compiled."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.waiting import HANG
from vpd_lightning.errors import ConfigError, NonFiniteError
from vpd_lightning.graph.neighbors import Neighbors, PointIndex, knn, radius

pytest.importorskip("triton")

IS_INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
interpreted = pytest.mark.skipif(not IS_INTERPRETED, reason="runs in the process that the last test starts")
DEVICES = [
    pytest.param("cpu", marks=interpreted),
    pytest.param("cuda", marks=pytest.mark.gpu),
]


def points_and_queries(count: int, num_queries: int, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(count)
    points = torch.randn(count, 3, generator=generator, dtype=dtype)
    near = torch.randn(1, 3, generator=generator, dtype=dtype)
    return points, near * torch.linspace(-3, 3, num_queries, dtype=dtype)[:, None]


def assert_found(found: Neighbors, points: Tensor, queries: Tensor, k: int, max_radius: float | None = None) -> None:
    """Distances equal brute force to the last bit; indices do where no two distances are equal, else they fit."""
    expected = knn(points.cpu(), queries.cpu(), k, max_radius, "torch")
    assert torch.equal(found.distance.cpu(), expected.distance)
    assert torch.equal(found.mask.cpu(), expected.mask)
    if len(points) == 0:
        return
    offset = points[found.index] - queries[:, None]
    again = (offset[..., 0].square() + offset[..., 1].square() + offset[..., 2].square()).sqrt()
    torch.testing.assert_close(again[found.mask], found.distance[found.mask], rtol=1e-6, atol=0)
    assert not bool(found.index[~found.mask].any())
    for row, mask in zip(found.index, found.mask, strict=True):
        assert len(set(row[mask].tolist())) == int(mask.sum())


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("count", "num_queries", "k"), [
    (1, 1, 1), (15, 33, 16), (16, 31, 16), (17, 32, 16), (33, 5, 3), (64, 3, 17), (600, 2, 2),
])  # fmt: skip
def test_odd_sizes(device: str, dtype: torch.dtype, count: int, num_queries: int, k: int) -> None:
    points, queries = (side.to(device) for side in points_and_queries(count, num_queries, dtype))
    for max_radius in (None, 0.8):
        assert_found(knn(points, queries, k, max_radius, "triton"), points, queries, k, max_radius)


CASES = {
    "duplicates": (torch.eye(3).repeat(30, 1), torch.eye(3)),
    "all in one place": (torch.ones(70, 3), torch.ones(2, 3)),
    "far from the origin": tuple(side + 1e4 for side in points_and_queries(70, 5)),
    "tiny": tuple(side * 1e-6 for side in points_and_queries(70, 5)),
    "huge": tuple(side * 1e6 for side in points_and_queries(70, 5)),
    "squares overflow": tuple(side * 1e25 for side in points_and_queries(70, 5)),
    "no points": (torch.zeros(0, 3), torch.ones(4, 3)),
    "no queries": (torch.ones(4, 3), torch.zeros(0, 3)),
}


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("case", CASES)
def test_hard_numbers(device: str, case: str) -> None:
    points, queries = (side.to(device) for side in CASES[case])
    assert_found(knn(points, queries, 5, backend="triton"), points, queries, 5)
    assert_found(knn(points, queries, 5, 0.0, "triton"), points, queries, 5, 0.0)


@pytest.mark.parametrize("device", DEVICES)
def test_the_radius_is_inclusive(device: str) -> None:
    points = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [0, 0.75, 0], [0, 0, 2]], device=device)
    found = knn(points, points[:1], 4, 0.5, "triton")
    assert found.index.tolist() == [[0, 1, 0, 0]] and found.mask.tolist() == [[True, True, False, False]]
    senders, receivers = radius(points, points[:1], 0.75, "triton")
    assert senders.tolist() == [0, 1, 2] and receivers.tolist() == [0, 0, 0]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kept", [0, 1, 40, 70])
def test_masked_points_are_never_found(device: str, kept: int) -> None:
    points, queries = (side.to(device) for side in points_and_queries(70, 5))
    mask = torch.zeros(70, dtype=torch.bool, device=device)
    mask[torch.randperm(70)[:kept].to(device)] = True
    points[~mask] = torch.nan
    found = PointIndex(points, "triton", mask=mask).knn(queries, 6)
    expected = PointIndex(points.cpu(), "torch", mask=mask.cpu()).knn(queries.cpu(), 6)
    assert torch.equal(found.distance.cpu(), expected.distance)
    assert torch.equal(found.index.cpu(), expected.index)
    senders, _ = PointIndex(points, "triton", mask=mask).radius(queries, 1e30)
    assert sorted(set(senders.tolist())) == mask.nonzero()[:, 0].tolist()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_what_is_not_finite_shows_in_everything_computed_from_the_result(device: str, bad: float) -> None:
    points, queries = (side.to(device) for side in points_and_queries(70, 5))
    broken_queries, broken_points = queries.clone(), points.clone()
    broken_queries[2, 1] = broken_points[30, 0] = bad
    found = knn(points, broken_queries, 6, backend="triton")
    assert bool(found.distance[2].isnan().all()) and bool(found.mask[2].all())
    assert bool(found.distance[[0, 1, 3, 4]].isfinite().all())
    found = knn(broken_points, queries, 6, backend="triton")
    assert bool(found.distance.isnan().all()) and bool(found.mask.all())
    assert found.index[:, 0].tolist() == [30] * 5
    with pytest.raises(NonFiniteError, match="1 of 70 points"):
        radius(broken_points, queries, 1.0, "triton")
    with pytest.raises(NonFiniteError, match="1 of 5 queries"):
        radius(points, broken_queries, 1.0, "triton")


@pytest.fixture
def _poisoned_memory() -> Iterator[None]:
    """In deterministic mode torch fills fresh memory with NaN and with the largest integers."""
    assert torch.utils.deterministic.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True, warn_only=True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.mark.usefixtures("_poisoned_memory")
@pytest.mark.parametrize("device", DEVICES)
def test_tables_are_written_in_full(device: str) -> None:
    assert bool(torch.empty(3, device=device).isnan().all())
    points, queries = (side.to(device) for side in points_and_queries(40, 35))
    assert_found(knn(points, queries, 16, 0.7, "triton"), points, queries, 16, 0.7)


@pytest.mark.gpu
def test_a_cuda_graph_can_hold_the_search() -> None:
    points, queries = (side.cuda() for side in points_and_queries(1000, 500))
    mask = torch.ones(1000, dtype=torch.bool, device="cuda")
    PointIndex(points, "triton", mask=mask).knn(queries, 16, 0.5)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        found = PointIndex(points, "triton", mask=mask).knn(queries, 16, 0.5)
    points.mul_(0.5)
    graph.replay()
    assert_found(found, points, queries, 16, 0.5)


@pytest.mark.slow
@pytest.mark.kernels
@pytest.mark.skipif(IS_INTERPRETED, reason="compiles")
@pytest.mark.parametrize("capability", [80, 90])
def test_the_kernel_compiles_for_gpus_without_fused_multiply_adds(capability: int) -> None:
    """Triton brings its own assembler, so this needs no GPU."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from vpd_lightning.graph.neighbors.triton_blocks import BLOCK_POINTS, BLOCK_QUERIES, BLOCKS_PER_GROUP, NUM_WARPS
    from vpd_lightning.graph.neighbors.triton_loops import knn_kernel

    constants = {"BLOCK_Q": BLOCK_QUERIES, "BLOCK_P": BLOCK_POINTS, "GROUP": BLOCKS_PER_GROUP, "K": 16}
    signature = dict.fromkeys(["points", "blocks", "groups", "queries", "table"], "*fp32")
    signature |= {"table_place": "*i32", "limit_pointer": "*fp32"}
    signature |= dict.fromkeys(["num_queries", "num_blocks", "num_groups", "k"], "i32")
    signature |= dict.fromkeys(constants, "constexpr")
    compiled = triton.compile(
        ASTSource(fn=knn_kernel, signature=signature, constexprs=constants),
        target=GPUTarget("cuda", capability, 32),
        options={"num_warps": NUM_WARPS, "enable_fp_fusion": False},
    )
    assert "cubin" in compiled.asm
    assert "fma.rn" not in compiled.asm["ptx"] and ".ftz" not in compiled.asm["ptx"]


@pytest.mark.skipif(IS_INTERPRETED, reason="compiled only")
def test_tensors_on_the_cpu_are_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="needs a GPU"):
        knn(torch.rand(5, 3), torch.rand(2, 3), 2, backend="triton")


@pytest.mark.slow
@pytest.mark.kernels
@pytest.mark.skipif(IS_INTERPRETED, reason="starts the process that this is")
def test_in_the_interpreter() -> None:
    result = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", str(Path(__file__))],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        timeout=HANG,
    )
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-1000:]
    assert " passed" in result.stdout
