"""HierarchicalGNNDynamics and its graph against Algorithm 1 written out edge by edge in float64."""

import numpy as np
import pytest
import torch
from torch import nn

from tests.reference import reference_algorithm1 as reference
from vpd_lightning.dynamics.blocks import MLP, EdgeUpdater, NodeUpdater
from vpd_lightning.dynamics.hierarchical_gnn import HierarchicalGNNDynamics
from vpd_lightning.graph.hierarchical import EdgeSet, HierarchicalGraph, build_graph
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles

FEATURE_DIM, HIDDEN_DIM, STEPS, NUM_ABSTRACT, LOCATION_SCALE = 4, 8, 3, 7, 0.1
R_S, R_A_S, MAX_NEIGHBORS = 0.35, 0.6, 2
NUM_PREVIOUS, NUM_CURRENT = 22, 25
VALID = {"previous": [22, 13], "current": [20, 25]}  # per batch member; the rest is padding


def _dynamics(
    normalized_edges: bool = False, aggregation: str = "sum", edge_gain: float = 1.0
) -> HierarchicalGNNDynamics:
    dynamics = HierarchicalGNNDynamics(
        feature_dim=FEATURE_DIM, hidden_dim=HIDDEN_DIM, message_passing_steps=STEPS, num_abstract_nodes=NUM_ABSTRACT,
        max_abstract_neighbors=MAX_NEIGHBORS, r_s=R_S, r_a_s=R_A_S, location_scale=LOCATION_SCALE,
        neighbors_backend="auto", edge_capacity=None, max_abstract_edges_per_node=None, compile=False,
        feature_limit=1e4, zero_init_decoders=False, normalized_edges=normalized_edges, edge_gain=edge_gain,
        aggregation=aggregation, update_features=True, has_driven=False,
    )  # fmt: skip
    # No weight stays at a value that would hide it: biases and layer norms are random too.
    generator = torch.Generator().manual_seed(0)
    for parameter in dynamics.parameters():
        nn.init.normal_(parameter, std=0.4, generator=generator)
    return dynamics.double()


def _particles(seed: int) -> tuple[Particles, Particles]:
    generator = np.random.default_rng(seed)
    made = []
    for name, size in (("previous", NUM_PREVIOUS), ("current", NUM_CURRENT)):
        mask = torch.arange(size) < torch.tensor(VALID[name])[:, None]
        mask = torch.stack([row[torch.from_numpy(generator.permutation(size))] for row in mask])  # padding anywhere
        positions = torch.from_numpy(generator.uniform(-0.5, 0.5, (2, size, 3)))
        features = torch.from_numpy(generator.normal(size=(2, size, FEATURE_DIM)))
        made.append(Particles(positions, features, mask))
    return made[0], made[1]


def _edges(edge_set: EdgeSet, sender_offset: int, receiver_offset: int, num_receivers: int) -> list[reference.Edge]:
    """The edges of one batch member, counted within it."""
    pairs = zip(*(ends.tolist() for ends in edge_set.pairs()), strict=True)
    shifted = [(sender - sender_offset, receiver - receiver_offset) for sender, receiver in pairs]
    return [(sender, receiver) for sender, receiver in shifted if 0 <= receiver < num_receivers]


def _graphs(dynamics: HierarchicalGNNDynamics, previous: Particles, current: Particles, keys: RandomKeys) -> tuple[
    HierarchicalGraph, list[np.ndarray], list[reference.Graph]
]:  # fmt: skip
    """The package's graph, where its abstract nodes are, and the brute-force graph around them, per batch member."""
    graph = build_graph(
        previous, current, keys.generators("abstract/0"), num_abstract_nodes=NUM_ABSTRACT,
        max_abstract_neighbors=MAX_NEIGHBORS, r_s=R_S, r_a_s=R_A_S, backend="auto",
    )  # fmt: skip
    abstract, expected = [], []
    for member in range(2):
        chosen = [i - member * NUM_CURRENT for i in graph.abstract_index.tolist() if i // NUM_CURRENT == member]
        assert len(set(chosen)) == NUM_ABSTRACT and all(current.mask[member, i] for i in chosen)
        centers = current.positions[member, chosen].double().numpy()
        abstract.append(centers)
        expected.append(
            reference.build_graph(
                previous.positions[member].double().numpy(), previous.mask[member].tolist(),
                current.positions[member].double().numpy(), current.mask[member].tolist(),
                centers, MAX_NEIGHBORS, R_S, R_A_S,
            )
        )  # fmt: skip
    return graph, abstract, expected


def test_the_graph_is_the_brute_force_graph() -> None:
    previous, current = _particles(0)
    graph, _, expected = _graphs(_dynamics(), previous, current, RandomKeys(0, 0, [0, 1]))
    degrees = []
    for member, truth in enumerate(expected):
        before, now, nodes = member * NUM_PREVIOUS, member * NUM_CURRENT, member * NUM_ABSTRACT
        found = {
            "previous_to_abstract": _edges(graph.previous_to_abstract, before, nodes, NUM_ABSTRACT),
            "current_to_abstract": _edges(graph.current_to_abstract, now, nodes, NUM_ABSTRACT),
            "abstract_to_abstract": _edges(graph.abstract_to_abstract, nodes, nodes, NUM_ABSTRACT),
            "abstract_to_current": _edges(graph.abstract_to_current, nodes, now, NUM_CURRENT),
        }
        for name, edges in found.items():
            assert sorted(edges) == sorted(getattr(truth, name)), name
        degree = [sum(1 for p, _ in truth.current_to_abstract if p == i) for i in range(NUM_CURRENT)]
        valid = current.mask[member].tolist()
        assert [bool(covered) for covered in graph.is_covered[member]] == [d > 0 for d in degree]
        degrees += [d for d, is_valid in zip(degree, valid, strict=True) if is_valid]
        assert 0 < len(truth.abstract_to_abstract) < NUM_ABSTRACT * (NUM_ABSTRACT - 1)
    assert set(degrees) == {0, 1, 2}, "the scene must hold uncovered particles, and some with one and two ties"


def _mlp(mlp: MLP, norm: nn.LayerNorm | None = None) -> reference.Mlp:
    def array(tensor: torch.Tensor) -> np.ndarray:
        return tensor.detach().double().numpy()

    layers = [(array(layer.weight), array(layer.bias)) for layer in mlp.layers]
    return reference.Mlp(layers, None if norm is None else (array(norm.weight), array(norm.bias), norm.eps))


def _updater(updater: EdgeUpdater | NodeUpdater) -> reference.Mlp:
    return _mlp(updater.mlp, updater.norm)


def _weights(dynamics: HierarchicalGNNDynamics) -> reference.Weights:
    """Where the module keeps which weights."""
    edges, nodes = dynamics.update_edge, dynamics.update_node
    return reference.Weights(
        encode_previous=_mlp(dynamics.encode_node["previous"]),
        encode_current=_mlp(dynamics.encode_node["current"]),
        encode_previous_to_abstract=_mlp(dynamics.encode_edge["previous_to_abstract"]),
        encode_current_to_abstract=_mlp(dynamics.encode_edge["current_to_abstract"]),
        encode_abstract_to_abstract=_mlp(dynamics.encode_edge["abstract_to_abstract"]),
        encode_abstract_to_current=_mlp(dynamics.encode_edge["abstract_to_current"]),
        update_previous_to_abstract=_updater(edges["previous_to_abstract"]),
        update_current_to_abstract=_updater(edges["current_to_abstract"]),
        update_abstract=_updater(nodes["abstract_first"]),
        process_edges=[_updater(updater) for updater in edges["abstract_to_abstract"]],
        process_nodes=[_updater(updater) for updater in nodes["abstract"]],
        update_abstract_to_current=_updater(edges["abstract_to_current"]),
        update_current=_updater(nodes["current"]),
        decode_location=_mlp(dynamics.decode_location),
        decode_feature=_mlp(dynamics.decode_feature),
    )


# float32: about thirty layers of order-one sums, each of which adds a few 2^-24, with layer norms that amplify where a
# row varies little; 2e-4 on features of size up to ten.
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 2e-4)])
@pytest.mark.parametrize(
    ("seed", "normalized_edges", "aggregation", "edge_gain"),
    [(0, False, "sum", 1.0), (1, False, "sum", 1.0), (0, True, "mean", 1.0), (1, True, "mean", 3.0)],
)
def test_one_application_matches_the_loops(
    seed: int, normalized_edges: bool, aggregation: str, edge_gain: float, dtype: torch.dtype, tolerance: float
) -> None:
    dynamics = _dynamics(normalized_edges, aggregation, edge_gain).to(dtype)
    previous, current = (particles.to(dtype) for particles in _particles(seed))
    keys = RandomKeys(seed=seed, step=0, sample_index=[0, 1])
    _, abstract, graphs = _graphs(dynamics, previous, current, keys)
    found, _ = dynamics(previous, current, None, keys, 0)
    weights = _weights(dynamics)
    assert torch.equal(found.mask, current.mask)
    for member in range(2):
        positions, features = reference.apply(
            weights,
            graphs[member],
            (previous.positions[member].double().numpy(), previous.features[member].double().numpy()),
            (current.positions[member].double().numpy(), current.features[member].double().numpy()),
            abstract[member],
            LOCATION_SCALE,
            units=(R_S / edge_gain, R_A_S) if normalized_edges else (1.0, 1.0),
            is_mean=aggregation == "mean",
        )
        valid = current.mask[member].numpy()
        for array, truth in ((found.positions, positions), (found.features, features)):
            got = array[member].detach().numpy()
            assert np.isfinite(got).all()
            np.testing.assert_allclose(got[valid], truth[valid], rtol=tolerance, atol=tolerance)
        moved = np.abs(positions - current.positions[member].double().numpy())[valid]
        assert moved.mean() > 1e-4 and moved.max() <= LOCATION_SCALE


def test_what_padding_holds_changes_nothing() -> None:
    dynamics = _dynamics()
    previous, current = _particles(2)
    keys = RandomKeys(seed=0, step=0, sample_index=[0, 1])
    clean, _ = dynamics(previous, current, None, keys, 0)
    spoilt = []
    for particles in (previous, current):
        hole = ~particles.mask[..., None]
        positions = torch.where(hole, current.positions[:, :1], particles.positions)
        spoilt.append(Particles(positions, torch.where(hole, 1e6, particles.features), particles.mask))
    dirty, _ = dynamics(*spoilt, None, keys, 0)
    mask = current.mask
    np.testing.assert_allclose(dirty.positions[mask].detach(), clean.positions[mask].detach(), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(dirty.features[mask].detach(), clean.features[mask].detach(), rtol=1e-6, atol=1e-6)
