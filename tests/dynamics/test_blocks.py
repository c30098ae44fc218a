import pytest
import torch
from torch import nn

from vpd_lightning.dynamics.blocks import MLP, EdgeUpdater, FullPrecisionLayerNorm, NodeUpdater
from vpd_lightning.graph.hierarchical import EdgeSet
from vpd_lightning.graph.incidence import Incidence


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_mlp_has_relu_between_layers_and_nothing_behind_the_last() -> None:
    mlp = MLP(3, (5, 7, 2)).double()
    inputs = torch.randn(4, 3, dtype=torch.float64)
    first, second, third = mlp.layers
    expected = third(second(first(inputs).clamp(min=0)).clamp(min=0))
    torch.testing.assert_close(mlp(inputs), expected)
    assert count(mlp) == (3 * 5 + 5) + (5 * 7 + 7) + (7 * 2 + 2)


def edges_between(num_edges: int, num_senders: int = 6, num_receivers: int = 9) -> EdgeSet:
    senders, receivers = torch.randint(0, num_senders, (num_edges,)), torch.randint(0, num_receivers, (num_edges,))
    return EdgeSet(Incidence.of(senders, num_senders), Incidence.of(receivers, num_receivers))


@pytest.mark.parametrize("num_edges", [0, 30])
@pytest.mark.parametrize("num_node_inputs", [1, 2])
def test_the_factored_first_layer_equals_the_concatenation(num_node_inputs: int, num_edges: int) -> None:
    updater, edge_set = EdgeUpdater(8, num_node_inputs).double(), edges_between(num_edges)
    edges, nodes, others = (torch.randn(size, 8).double() for size in (num_edges, 6, 9))
    columns = [edges, nodes[edge_set.senders.index], others[edge_set.receivers.index]][: 1 + num_node_inputs]
    expected = edges + updater.norm(updater.mlp(torch.cat(columns, dim=-1)))
    got = updater(edges, nodes, others if num_node_inputs == 2 else None, edge_set)
    # Only the order of summation differs.
    torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-12)
    assert updater.mlp.layers[0].weight.shape == (8, 8 * (1 + num_node_inputs))


@pytest.mark.parametrize("num_edges", [4095, 4096, 9000])
def test_edges_in_pieces_without_gradients_are_the_edges_at_once(num_edges: int) -> None:
    updater, edge_set = EdgeUpdater(8, 2), edges_between(num_edges)
    edges, nodes, others = (torch.randn(size, 8) for size in (num_edges, 6, 9))
    expected = updater(edges, nodes, others, edge_set)
    with torch.no_grad():
        got = updater(edges.clone(), nodes, others, edge_set)
    # float32 products of other shapes may be added up in another order.
    torch.testing.assert_close(got, expected.detach(), rtol=1e-5, atol=1e-5)


def test_an_updater_leaves_its_input_alone_where_gradients_need_it() -> None:
    updater, edge_set, edges = EdgeUpdater(8, 2), edges_between(30), torch.randn(30, 8)
    kept = edges.clone()
    updater(edges, torch.randn(6, 8), torch.randn(9, 8), edge_set)
    assert torch.equal(edges, kept)


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


@pytest.mark.parametrize("is_autocast", [False, True])
def test_layer_norm_of_bfloat16_is_computed_in_float32_and_rounded_once(is_autocast: bool) -> None:
    norm = FullPrecisionLayerNorm(64)
    with torch.no_grad():
        norm.weight.uniform_(0.5, 2)
        norm.bias.normal_()
    inputs = (100 + torch.randn(50, 64)).bfloat16()  # whose variance bfloat16 could not tell
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=is_autocast):
        outputs = norm(inputs)
    assert outputs.dtype == torch.bfloat16
    exact = nn.functional.layer_norm(inputs.double(), (64,), norm.weight.double(), norm.bias.double(), norm.eps)
    torch.testing.assert_close(outputs.double(), exact, rtol=2**-8, atol=1e-3)


def test_impossible_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="widths"):
        MLP(3, ())
    with pytest.raises(ValueError, match="num_node_inputs"):
        EdgeUpdater(8, 3)
