"""Particles as PyTorch Geometric's ``Data``, and back: for graph networks and tools of other people."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch_geometric.data import Batch, Data

from vpd_lightning.graph.neighbors import radius
from vpd_lightning.types import Particles

_CARRIED = ("colors", "moving", "normals")


def to_graph_data(particles: Particles, *, edge_radius: float | None) -> Data:
    """Return particles as a ``Data``, or as a ``Batch`` of one for each member where there is a batch axis.

    ``pos`` (node, 3) are the positions in metres, ``x`` the features; ``colors``, ``moving`` and ``normals`` are there
    where the particles have them. Padding is left out: ``slot`` is the index of each node in the padded table, and
    ``num_slots`` how long that was, so that ``from_graph_data`` gives the same table again.

    With ``edge_radius`` (metres) ``edge_index`` joins particles that are no farther apart, both ways and none with
    itself, sorted by target, then source; without (None) there are no edges.

    Raises:
        ValueError: ``edge_radius`` is negative, or there is more than one batch axis, or an empty one.
        NonFiniteError: edges of positions that are not finite.
    """
    axes = particles.positions.dim() - 2
    if axes == 0:
        return _to_data(particles, edge_radius)
    if axes > 1 or particles.positions.shape[0] == 0:
        raise ValueError(f"particles must have at most one batch axis, not empty; got {tuple(particles.mask.shape)}")
    members = [_member(particles, index) for index in range(particles.positions.shape[0])]
    return Batch.from_data_list([_to_data(member, edge_radius) for member in members])


def from_graph_data(data: Data) -> Particles:
    """Return particles from a ``Data`` (no batch axis) or a ``Batch`` (one), also from one made elsewhere.

    Nodes without ``slot`` are taken in their order, and members are padded to the longest; padding holds zeros. Edges
    are dropped.

    Raises:
        ValueError: ``pos`` is not (node, 3), ``x`` is not (node, feature), or ``slot`` does not give every node a place
            of its own.
    """
    members = data.to_data_list() if isinstance(data, Batch) else [data]
    slots = [_slots(member) for member in members]
    length = max(num_slots for _, num_slots in slots)
    tables = {}
    for name, key in (("positions", "pos"), ("features", "x"), *((name, name) for name in _CARRIED)):
        if key in members[0]:
            parts = [_spread(member[key], slot, length) for member, (slot, _) in zip(members, slots, strict=True)]
            tables[name] = torch.stack(parts) if isinstance(data, Batch) else parts[0]
    masks = [_spread(torch.ones_like(slot, dtype=torch.bool), slot, length) for slot, _ in slots]
    return Particles(**tables, mask=torch.stack(masks) if isinstance(data, Batch) else masks[0])


def _to_data(particles: Particles, edge_radius: float | None) -> Data:
    there = particles.mask.nonzero()[:, 0]
    positions = particles.positions[there]
    carried = {name: value[there] for name in _CARRIED if (value := getattr(particles, name)) is not None}
    edges = {} if edge_radius is None else {"edge_index": _edges(positions, edge_radius)}
    return Data(
        x=particles.features[there], pos=positions, slot=there, num_slots=particles.num_particles, **carried, **edges
    )


def _edges(positions: Float[Tensor, "node 3"], edge_radius: float) -> Int64[Tensor, "2 edge"]:
    sources, targets = radius(positions, positions, edge_radius)
    apart = sources != targets
    return torch.stack([sources[apart], targets[apart]])


def _member(particles: Particles, index: int) -> Particles:
    values = {name: getattr(particles, name) for name in ("positions", "features", "mask", *_CARRIED)}
    return Particles(**{name: None if value is None else value[index] for name, value in values.items()})


def _slots(data: Data) -> tuple[Int64[Tensor, " node"], int]:
    """Return the place of every node, and how many places there are."""
    positions, features = data.pos, data.x
    if positions is None or positions.dim() != 2 or positions.shape[1] != 3:
        raise ValueError("a graph of particles needs positions: pos (node, 3)")
    count = len(positions)
    if features is None or features.dim() != 2 or len(features) != count:
        raise ValueError(f"a graph of particles needs features: x (node, feature) for its {count} nodes")
    if "slot" not in data:
        return torch.arange(count, device=positions.device), count
    slot, num_slots = data.slot, int(data.num_slots)
    is_place = count == 0 or (int(slot.min()) >= 0 and int(slot.max()) < num_slots)
    if slot.shape != (count,) or not is_place or len(slot.unique()) < count:
        raise ValueError(f"slot must give each of the {count} nodes a place of its own, 0 to {num_slots - 1}")
    return slot, num_slots


def _spread(values: Tensor, slot: Int64[Tensor, " node"], length: int) -> Tensor:
    table = values.new_zeros(length, *values.shape[1:])
    table[slot] = values
    return table
