"""Algorithm 1 of the paper written plainly: concatenated edges, scattered sums, one member of the batch at a time."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from benchmarks.plain.neighbors import nearest, pairs_within
from vpd_lightning.dynamics.hierarchical_gnn import HierarchicalGNNDynamics
from vpd_lightning.graph.hierarchical import draw_priorities
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles


def advance(
    model: HierarchicalGNNDynamics,
    previous: Particles,
    current: Particles,
    memory: Any,
    keys: RandomKeys,
    rollout_step: int,
) -> tuple[Particles, Any]:
    """Return the particles of the next step, from the weights and the random draws of ``model``."""
    positions, features = [], []
    priorities = draw_priorities(keys.generators(f"abstract/{rollout_step}"), current.num_particles)
    for member, priority in enumerate(priorities):
        before, now = (
            (p.positions[member][p.mask[member]], p.features[member][p.mask[member]]) for p in (previous, current)
        )
        location, feature = _changes(model, *before, *now, priority)
        place = current.mask[member].nonzero()[:, 0]
        positions.append(current.positions[member].index_add(0, place, location))
        features.append(current.features[member].index_add(0, place, feature))
    return replace(current, positions=torch.stack(positions), features=torch.stack(features)), memory


def _changes(
    model: HierarchicalGNNDynamics,
    x_previous: Tensor,
    z_previous: Tensor,
    x_current: Tensor,
    z_current: Tensor,
    priority: Tensor,
) -> tuple[Tensor, Tensor]:
    chosen = priority[: len(x_current)].argsort(stable=True)[: model.num_abstract_nodes].to(x_current.device)
    x_abstract = x_current[chosen]
    count = len(chosen)

    def edges_to_nodes(positions: Tensor) -> tuple[Tensor, Tensor]:
        """Particle and abstract node of each edge between them."""
        index, distance = nearest(x_abstract, positions, model.max_abstract_neighbors)
        near = distance <= model.r_s
        return near.nonzero()[:, 0], index[near]

    previous_edges, current_edges = edges_to_nodes(x_previous), edges_to_nodes(x_current)
    senders, receivers = pairs_within(x_abstract, model.r_a_s)

    v_previous = model.encode_node["previous"](z_previous)
    v_current = model.encode_node["current"](z_current)

    messages = v_current.new_zeros(count, v_current.shape[1])
    for name, x, v, (particle, node) in (
        ("previous_to_abstract", x_previous, v_previous, previous_edges),
        ("current_to_abstract", x_current, v_current, current_edges),
    ):
        edge = model.encode_edge[name](x[particle] - x_abstract[node])
        edge = _updated(model.update_edge[name], edge, torch.cat([edge, v[particle]], dim=-1))
        messages = messages.index_add(0, node, edge)
    update = model.update_node["abstract_first"]
    v_abstract = update.norm(update.mlp(messages))

    edge = model.encode_edge["abstract_to_abstract"](x_abstract[senders] - x_abstract[receivers])
    for update_edge, update_node in zip(
        model.update_edge["abstract_to_abstract"], model.update_node["abstract"], strict=True
    ):
        edge = _updated(update_edge, edge, torch.cat([edge, v_abstract[senders], v_abstract[receivers]], dim=-1))
        messages = torch.zeros_like(v_abstract).index_add(0, receivers, edge)
        v_abstract = _updated(update_node, v_abstract, torch.cat([v_abstract, messages], dim=-1))

    particle, node = current_edges
    edge = model.encode_edge["abstract_to_current"](x_abstract[node] - x_current[particle])
    together = torch.cat([edge, v_abstract[node], v_current[particle]], dim=-1)
    edge = _updated(model.update_edge["abstract_to_current"], edge, together)
    messages = torch.zeros_like(v_current).index_add(0, particle, edge)
    v_current = _updated(model.update_node["current"], v_current, torch.cat([v_current, messages], dim=-1))
    return model.location_scale * torch.tanh(model.decode_location(v_current)), model.decode_feature(v_current)


def _updated(update: Any, old: Tensor, inputs: Tensor) -> Tensor:
    """``old + LayerNorm(MLP(inputs))``, the concatenated inputs multiplied as they stand."""
    return old + update.norm(update.mlp(inputs))
