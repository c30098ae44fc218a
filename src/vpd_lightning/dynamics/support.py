"""Which particles something holds up: islands of particles that hang together, and those that contain the ground."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from vpd_lightning.graph.neighbors import PointIndex

_CELLS_PER_LINK = 4
"""Points are first merged in cells this many times smaller than a link, so that dense bodies cost no more than thin
ones; where islands end is known to within such a cell."""

_MAX_CELLS = 2**53
"""Cells along one axis, so that they fit an integer however far a particle was thrown."""


@torch.no_grad()
def islands(points: Float[Tensor, "particle 3"], link_radius: float, backend: str) -> Int64[Tensor, " particle"]:
    """Return the island of each point: islands are chains of points no farther apart than ``link_radius`` (metres).

    Exact up to the size of a cell, a quarter of a link. The same for any order of the points and any place of the
    world; islands are numbered from 0.

    Raises:
        NonFiniteError: when a coordinate is not finite.
    """
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.int64, device=points.device)
    cell = link_radius / _CELLS_PER_LINK
    place = ((points - points.amin(dim=0)) / cell).clamp(max=_MAX_CELLS - 1).to(torch.int64)
    _, cell_index, count = torch.unique(place, dim=0, return_inverse=True, return_counts=True)
    centers = points.new_zeros(len(count), 3).index_add_(0, cell_index, points) / count[:, None]
    senders, receivers = PointIndex(centers, backend, is_radius=True).radius(centers, link_radius)
    links = coo_array(
        (np.ones(len(senders), dtype=bool), (senders.cpu().numpy(), receivers.cpu().numpy())), shape=(len(count),) * 2
    )
    _, labels = connected_components(links, directed=False)
    return torch.from_numpy(labels).to(points.device, torch.int64)[cell_index]


@torch.no_grad()
def on_ground(
    points: Float[Tensor, "particle 3"], link_radius: float, ground_width: float, backend: str
) -> Bool[Tensor, " particle"]:
    """Return which points belong to an island at least ``ground_width`` metres wide, along x or y (z is up).

    A floor is wide and a body is not, wherever in the picture it flies; what touches the floor hangs together with it,
    through other bodies too.
    """
    island = islands(points, link_radius, backend)
    number = int(island.max()) + 1 if len(island) else 0
    across = points[:, :2]
    index = island[:, None].expand(-1, 2)
    low = across.new_zeros(number, 2).scatter_reduce_(0, index, across, "amin", include_self=False)
    high = across.new_zeros(number, 2).scatter_reduce_(0, index, across, "amax", include_self=False)
    return ((high - low).amax(dim=1) >= ground_width)[island]


@torch.no_grad()
def within_reach(
    queries: Float[Tensor, "query 3"], sources: Float[Tensor, "source 3"], max_radius: float, backend: str
) -> Bool[Tensor, " query"]:
    """Return which queries have a source no farther away than ``max_radius`` metres.

    Raises:
        NonFiniteError: when a coordinate is not finite.
    """
    return PointIndex(sources, backend).knn(queries, 1, max_radius).mask[:, 0]
