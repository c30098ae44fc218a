import pytest
import torch

from vpd_lightning.dynamics.blocks import MLP, EdgeUpdater, FullPrecisionLayerNorm, NodeUpdater, summed_at_receivers


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_mlp_has_relu_between_layers_and_nothing_behind_the_last() -> None:
    mlp = MLP(3, (5, 7, 2)).double()
    inputs = torch.randn(4, 3, dtype=torch.float64)
    first, second, third = mlp.layers
    expected = third(second(first(inputs).clamp(min=0)).clamp(min=0))
    torch.testing.assert_close(mlp(inputs), expected)
    assert count(mlp) == (3 * 5 + 5) + (5 * 7 + 7) + (7 * 2 + 2)


@pytest.mark.parametrize("num_node_inputs", [1, 2])
def test_the_factored_first_layer_equals_the_concatenation(num_node_inputs: int) -> None:
    updater = EdgeUpdater(8, num_node_inputs).double()
    edges, senders, receivers = torch.randn(30, 8).double(), torch.randint(0, 6, (30,)), torch.randint(0, 9, (30,))
    nodes, others = torch.randn(6, 8).double(), torch.randn(9, 8).double()
    columns = [edges, nodes[senders], others[receivers]][: 1 + num_node_inputs]
    expected = edges + updater.norm(updater.mlp(torch.cat(columns, dim=-1)))
    got = updater(edges, nodes, others if num_node_inputs == 2 else None, senders, receivers)
    # Only the order of summation differs.
    torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-12)
    assert updater.mlp.layers[0].weight.shape == (8, 8 * (1 + num_node_inputs))


def test_a_node_without_features_is_neither_concatenated_nor_added() -> None:
    updater = NodeUpdater(8, has_nodes=False)
    messages = torch.randn(5, 8)
    torch.testing.assert_close(updater(None, messages), updater.norm(updater.mlp(messages)))
    assert updater.mlp.layers[0].weight.shape == (8, 8)
    with pytest.raises(ValueError, match="without"):
        updater(messages, messages)


def test_a_node_with_features_keeps_a_residual() -> None:
    updater = NodeUpdater(8, has_nodes=True)
    nodes, messages = torch.randn(5, 8), torch.randn(5, 8)
    expected = nodes + updater.norm(updater.mlp(torch.cat([nodes, messages], dim=-1)))
    torch.testing.assert_close(updater(nodes, messages), expected)


def test_sums_at_receivers_match_a_loop_and_pass_gradcheck() -> None:
    edges = torch.randn(7, 3, dtype=torch.float64, requires_grad=True)
    offsets = torch.tensor([0, 0, 3, 3, 7])
    expected = torch.stack([edges[0:0].sum(0), edges[0:3].sum(0), edges[3:3].sum(0), edges[3:7].sum(0)])
    torch.testing.assert_close(summed_at_receivers(edges, offsets), expected)
    assert torch.autograd.gradcheck(lambda values: summed_at_receivers(values, offsets), edges)


def test_sums_of_no_edges_are_zero_and_keep_the_graph() -> None:
    edges = torch.zeros(0, 3, requires_grad=True)
    total = summed_at_receivers(edges, torch.zeros(5, dtype=torch.int64))
    assert torch.equal(total, torch.zeros(4, 3))
    assert total.requires_grad


def test_layer_norm_stays_in_float32_under_autocast() -> None:
    norm = FullPrecisionLayerNorm(8)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert norm(torch.randn(3, 8).bfloat16()).dtype == torch.float32


def test_impossible_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="widths"):
        MLP(3, ())
    with pytest.raises(ValueError, match="num_node_inputs"):
        EdgeUpdater(8, 3)
