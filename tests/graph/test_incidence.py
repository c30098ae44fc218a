import pytest
import torch

from vpd_lightning.graph.incidence import Incidence, gather_to_edges

NUM_SENDERS, NUM_RECEIVERS, NUM_EDGES = 7, 9, 60


def ends(num_edges: int = NUM_EDGES) -> tuple[torch.Tensor, torch.Tensor]:
    """Random ends of edges; the last number of each side means that there is none."""
    return torch.randint(0, NUM_SENDERS + 1, (num_edges,)), torch.randint(0, NUM_RECEIVERS + 1, (num_edges,))


def through_edges(senders: Incidence, receivers: Incidence, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    rows, more, edges = inputs
    hidden = gather_to_edges(rows, senders, more, receivers) + edges
    return receivers.summed(hidden * hidden), senders.summed(hidden)


def the_same_by_index_add(senders: torch.Tensor, receivers: torch.Tensor, *inputs: torch.Tensor) -> tuple:
    rows, more, edges = inputs
    zero = rows.new_zeros(1, rows.shape[1])
    hidden = torch.cat([rows, zero])[senders] + torch.cat([more, zero])[receivers] + edges
    at_receivers = rows.new_zeros(NUM_RECEIVERS + 1, rows.shape[1]).index_add(0, receivers, hidden * hidden)
    at_senders = rows.new_zeros(NUM_SENDERS + 1, rows.shape[1]).index_add(0, senders, hidden)
    return at_receivers[:NUM_RECEIVERS], at_senders[:NUM_SENDERS]


def inputs_of(dtype: torch.dtype, num_edges: int = NUM_EDGES) -> list[torch.Tensor]:
    sizes = (NUM_SENDERS, NUM_RECEIVERS, num_edges)
    return [torch.randn(size, 5, dtype=dtype, requires_grad=True) for size in sizes]


# float32 takes another route on a CPU; it adds in the same order, so a handful of roundings is all there can be.
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-13), (torch.float32, 2e-5)])
@pytest.mark.parametrize("num_edges", [0, 1, 60])
def test_carrying_and_summing_match_plain_indexing(num_edges: int, dtype: torch.dtype, tolerance: float) -> None:
    senders, receivers = ends(num_edges)
    incidences = Incidence.of(senders, NUM_SENDERS), Incidence.of(receivers, NUM_RECEIVERS)
    inputs = inputs_of(dtype, num_edges)
    gradients = []
    outputs = []
    for function, given in ((through_edges, incidences), (the_same_by_index_add, (senders, receivers))):
        results = function(*given, *inputs)
        outputs.append(results)
        gradients.append(torch.autograd.grad(sum(one.sin().sum() for one in results), inputs))
    for found, expected in zip((*outputs[0], *gradients[0]), (*outputs[1], *gradients[1]), strict=True):
        torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)


def test_gradients_match_finite_differences() -> None:
    senders, receivers = ends()
    given = Incidence.of(senders, NUM_SENDERS), Incidence.of(receivers, NUM_RECEIVERS)
    assert torch.autograd.gradcheck(lambda *inputs: through_edges(*given, *inputs), inputs_of(torch.float64))


def test_a_table_is_the_same_edges_as_a_list() -> None:
    mask = torch.rand(NUM_SENDERS, 3) < 0.6
    table = Incidence.of_table(mask)
    as_list = Incidence.of(table.index, NUM_SENDERS)
    assert torch.equal(table.index.view(-1, 3) < NUM_SENDERS, mask)
    rows, edges = (torch.randn(n, 4, dtype=torch.float64, requires_grad=True) for n in (NUM_SENDERS, 3 * NUM_SENDERS))
    found, expected = (one.summed(edges * gather_to_edges(rows, one)) for one in (table, as_list))
    torch.testing.assert_close(found, expected, rtol=1e-13, atol=1e-13)
    gradients = [torch.autograd.grad(one.square().sum(), (rows, edges), retain_graph=True) for one in (found, expected)]
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("is_table", [False, True])
def test_not_a_number_on_padding_stays_there(is_table: bool, dtype: torch.dtype) -> None:
    mask = torch.tensor([[True, False], [False, False], [True, True]])
    incidence = Incidence.of_table(mask)
    if not is_table:
        incidence = Incidence.of(incidence.index, 3)
    edges = torch.where(mask.flatten()[:, None], 1.0, torch.nan).to(dtype).expand(6, 4).clone().requires_grad_()
    total = incidence.summed(edges)
    assert total[:, 0].tolist() == [1, 0, 2]
    total.sum().backward()
    assert torch.equal(edges.grad[:, 0] > 0, mask.flatten()), "padding gets a gradient of zero"
    assert torch.equal(gather_to_edges(torch.ones(3, 4, dtype=dtype), incidence)[:, 0] > 0, mask.flatten())


def test_half_precision_is_summed_in_float32() -> None:
    # 4,096 ones: bfloat16 sums stop growing at 256.
    incidence = Incidence.of(torch.zeros(4096, dtype=torch.int64), 1, is_sorted=True)
    assert incidence.summed(torch.ones(4096, 1, dtype=torch.bfloat16)).item() == 4096


def test_no_edges_and_no_nodes_are_sums_of_nothing() -> None:
    for num_nodes in (0, 4):
        nothing = Incidence.of(torch.zeros(0, dtype=torch.int64), num_nodes)
        rows, edges = torch.randn(num_nodes, 3, requires_grad=True), torch.zeros(0, 3, requires_grad=True)
        total = nothing.summed(edges + gather_to_edges(rows, nothing))
        assert torch.equal(total, torch.zeros(num_nodes, 3))
        total.sum().backward()
        assert torch.equal(rows.grad, torch.zeros(num_nodes, 3))


@pytest.mark.gpu
def test_sums_on_a_gpu_repeat_bit_for_bit() -> None:
    index = torch.randint(0, 50, (20_000,), device="cuda")
    incidence, edges = Incidence.of(index, 50), torch.randn(20_000, 64, device="cuda")
    torch.use_deterministic_algorithms(True)
    try:
        assert torch.equal(incidence.summed(edges), incidence.summed(edges))
    finally:
        torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("width", [1, 2, 3])
@pytest.mark.parametrize("is_padded", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_sums_and_means_of_a_table_are_those_of_a_loop(width: int, is_padded: bool, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(width)
    mask = torch.rand(9, width, generator=generator) < 0.6 if is_padded else torch.ones(9, width, dtype=torch.bool)
    mask[4] = not is_padded  # with padding, one node has no edge at all
    edges = torch.randn(9 * width, 5, generator=generator).to(dtype)
    edges[~mask.flatten()] = torch.nan
    given = edges.clone()
    table = Incidence.of_table(mask)

    rows = [[edges[node * width + k].double() for k in range(width) if mask[node, k]] for node in range(9)]
    sums = torch.stack([sum(row, torch.zeros(5, dtype=torch.float64)) for row in rows])
    counts = torch.tensor([max(1, len(row)) for row in rows])[:, None]

    # A few sums of numbers of order one: 2^-24 of them in float32, and the result's own 2^-9 in bfloat16.
    tolerance = 1e-6 if dtype == torch.float32 else 0.02
    torch.testing.assert_close(table.summed(edges).double(), sums, rtol=0, atol=tolerance)
    torch.testing.assert_close(table.mean(edges).double(), sums / counts, rtol=0, atol=tolerance)
    assert table.counts().tolist() == mask.sum(dim=1).tolist()
    torch.testing.assert_close(edges, given, rtol=0, atol=0, equal_nan=True)  # what was given is not written to
