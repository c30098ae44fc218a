"""Which body stands first on a ray through the picture."""

import torch
from jaxtyping import Float, Int64
from scipy.spatial import cKDTree
from torch import Tensor

from vpd_lightning.types import Particles

_REACH = 1.5
"""A ray hits particles that lie within this many spacings of it."""


def spacing(particles: Particles) -> float:
    """Return the median distance (metres) of a particle to its nearest neighbour; 1 cm where there are fewer than two.

    ``particles`` have a batch axis of 1.
    """
    points = particles.positions[0][particles.mask[0]].double().cpu().numpy()
    if len(points) < 2:
        return 0.01
    return max(float(torch.from_numpy(cKDTree(points).query(points, k=2)[0][:, 1]).median()), 1e-4)


def body_at(
    particles: Particles,
    clusters: Int64[Tensor, " particle"],
    origin: Float[Tensor, " 3"],
    direction: Float[Tensor, " 3"],
    reach: float | None = None,
) -> int | None:
    """Return the cluster of the nearest particle on a ray; None where that is scenery, or where there is nothing.

    ``particles`` have a batch axis of 1; ``clusters`` are -1 for scenery. ``reach`` (metres) is how far from the ray a
    particle is hit (default: 1.5 spacings). A body wins over scenery within that length behind it: the floor under a
    body begins where the body ends.
    """
    reach = _REACH * spacing(particles) if reach is None else reach
    ray = direction.double() / direction.double().norm()
    offsets = particles.positions[0].double().cpu() - origin.double()
    along = offsets @ ray
    aside = (offsets - along[:, None] * ray).norm(dim=-1)
    hit = particles.mask[0].cpu() & (along > 0) & (aside <= reach)
    if not bool(hit.any()):
        return None
    labels = clusters.cpu()
    nearest = along[hit].min()
    on_body = hit & (labels >= 0)
    if not bool(on_body.any()) or along[on_body].min() > nearest + 2 * reach:
        return None
    return int(labels[on_body][along[on_body].argmin()])
