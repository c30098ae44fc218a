"""Which particles hang together as one body: islands of convexly connected particles."""

from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

_SPACING_RANK = 4
"""The distance to this many-th nearest particle is what is called spacing: one missing neighbour hardly changes it."""

_SPARSEST = 2.5
"""How many times the usual spacing particles may lie apart where cameras see a surface from the side."""

_JOIN_SHARE = 0.8
"""Islands between which at least this share of the pairs is not concave are parts of one body."""

_PART_SHARE = 0.25
"""An island of at most this share of another one may be a sparsely seen part of it."""

_SAME_TONE, _MAX_TONE_SPREAD = 0.06, 0.15
"""Islands of one colour each (standard deviation of its chromaticity) and of the same colour are parts of one body."""

_SAME_TONE_REACH = 2.5
"""How many spacings of the wider-spaced one such parts may lie apart: what is between them may be hidden."""

_MIN_PARTICLES, _MIN_SHARE = 8, 0.0125
"""An island of fewer particles is no body. One of a smaller share of all is one only if no other island is near."""

_MIN_LENGTH = 2.5
"""No body is taken for shorter than this many usual spacings."""


@torch.no_grad()
def label_bodies(
    positions: Float[Tensor, "batch particle 3"],
    normals: Float[Tensor, "batch particle 3"],
    colors: Float[Tensor, "batch particle 3"],
    mask: Bool[Tensor, "batch particle"],
    *,
    num_bodies: int,
    link: float,
    max_concavity: float,
    max_concave_share: float,
) -> Int64[Tensor, "batch particle"]:
    """Return the body of each particle, from 0 (the one with most particles) on; -1 where it belongs to none.

    Two particles are linked where they lie within ``link`` spacings of each other and the surface between them is not
    concave: (n_i - n_j) . (x_i - x_j) / |x_i - x_j| is at least ``-max_concavity`` (after the convexity criterion of
    Stein et al. 2014, "Object partitioning using local convexity"). Bodies touch in a concave seam. A particle
    with more than ``max_concave_share`` of concave pairs is linked with none: at a contact, one pair that is not
    concave would be enough to join two bodies. Islands are merged again if nearly all pairs between them are not
    concave, or if they are close and of one and the same colour: parts of a concave body, which convexity alone would
    divide. So two touching bodies of one colour are taken for one. Particles in no island of some size, and islands
    beyond ``num_bodies``, join the nearest body, but for strays that are farther from it than it is long: they belong
    to none, and so do particles where ``mask`` is false. Scene by scene, on the CPU; the numbers do not depend on the
    order of the particles, nor on the world's origin or scale.
    """
    labels = torch.full(mask.shape, -1, dtype=torch.int64)
    for member, own in enumerate(mask.cpu()):
        if bool(own.any()):
            where = own.nonzero().flatten()
            points, directions, tones = (
                values[member].detach().to("cpu", torch.float64)[where].numpy()
                for values in (positions, normals, colors)
            )
            found = _label(points, directions, tones, num_bodies, link, max_concavity, max_concave_share)
            labels[member, where] = torch.from_numpy(found)
    return labels.to(mask.device)


def _islands(senders: np.ndarray, receivers: np.ndarray, count: int) -> np.ndarray:
    links = coo_array((np.ones(len(senders), bool), (senders, receivers)), shape=(count, count))
    return connected_components(links, directed=False)[1]


def _joined(
    islands: np.ndarray, senders: np.ndarray, receivers: np.ndarray, smooth: np.ndarray, max_share: float
) -> np.ndarray:
    """Join islands between which nearly all pairs of particles are not concave: parts of one body.

    One of the two must have at most ``max_share`` of the particles of the other. Stray particles would be bridges.
    """
    count, sizes = int(islands.max()) + 1, np.bincount(islands)
    across = islands[senders] != islands[receivers]
    low = np.minimum(islands[senders[across]], islands[receivers[across]])
    high = np.maximum(islands[senders[across]], islands[receivers[across]])
    pairs, which = np.unique(low * count + high, return_inverse=True)
    low, high = np.divmod(pairs, count)
    number = np.bincount(which, minlength=len(pairs))
    share = np.bincount(which, smooth[across], minlength=len(pairs)) / number.clip(1)
    smaller, larger = np.minimum(sizes[low], sizes[high]), np.maximum(sizes[low], sizes[high])
    join = (share > _JOIN_SHARE) & (smaller <= max_share * larger) & (smaller >= _MIN_PARTICLES)
    return _islands(low[join], high[join], count)[islands]


def _joined_by_color(islands: np.ndarray, points: np.ndarray, colors: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Join islands near each other that have one colour, the same; see ``_SAME_TONE``."""
    sizes = np.bincount(islands)
    large = np.flatnonzero(sizes >= _MIN_PARTICLES)
    tones = colors / (colors.sum(axis=-1, keepdims=True) + 0.15)  # as in dynamics.first_velocity.chromaticity
    parts = [np.flatnonzero(islands == number) for number in large]
    means = [tones[part].mean(axis=0) for part in parts]
    plain = [number for number, part in enumerate(parts) if tones[part].var(axis=0).sum() < _MAX_TONE_SPREAD**2]
    joined = []
    for first, second in combinations(plain, 2):
        if np.linalg.norm(means[first] - means[second]) < _SAME_TONE:
            one, other = parts[first], parts[second]
            reach = _SAME_TONE_REACH * max(np.median(spacing[one]), np.median(spacing[other]))
            distances, _ = cKDTree(points[one]).query(points[other], distance_upper_bound=reach)
            if np.isfinite(distances).any():
                joined.append((large[first], large[second]))
    if not joined:
        return islands
    senders, receivers = np.array(joined).T
    return _islands(senders, receivers, len(sizes))[islands]


def _length(points: np.ndarray) -> float:
    """Return the diameter (metres) of the sphere around the mean of the points that holds them all."""
    return 2 * float(np.linalg.norm(points - points.mean(axis=0), axis=-1).max())


def _label(
    points: np.ndarray,
    normals: np.ndarray,
    colors: np.ndarray,
    num_bodies: int,
    link: float,
    max_concavity: float,
    max_concave_share: float,
) -> np.ndarray:
    count = len(points)
    tree = cKDTree(points)
    rank = min(_SPACING_RANK, count - 1)
    if rank < 1:
        return np.zeros(count, dtype=np.int64)
    spacing = tree.query(points, k=[rank + 1])[0][:, 0]
    usual = np.median(spacing)
    spacing = spacing.clip(usual, _SPARSEST * usual)
    senders, receivers = tree.query_pairs(link * spacing.max() * (1 + 1e-9), output_type="ndarray").T
    steps = points[senders] - points[receivers]
    lengths = np.sqrt((steps**2).sum(axis=-1)).clip(min=np.finfo(float).tiny)
    near = lengths <= link * np.minimum(spacing[senders], spacing[receivers]) * (1 + 1e-9)
    senders, receivers, steps, lengths = senders[near], receivers[near], steps[near], lengths[near]
    turn = ((normals[senders] - normals[receivers]) * steps).sum(axis=-1) / lengths
    known = (normals**2).sum(axis=-1) > 0.5
    smooth = known[senders] & known[receivers] & (turn > -max_concavity)

    usual_pair = lengths <= link * usual * (1 + 1e-9)
    first, second, convex = senders[usual_pair], receivers[usual_pair], smooth[usual_pair]
    pairs = np.bincount(np.r_[first, second], minlength=count)
    num_concave = np.bincount(np.r_[first[~convex], second[~convex]], minlength=count)
    clean = num_concave <= max_concave_share * pairs
    sure = convex & clean[first] & clean[second]
    islands = _islands(first[sure], second[sure], count)
    islands = _joined(islands, first, second, convex, 1.0)
    # Where a surface is seen from the side its points lie wide apart: such parts belong to a body, but are none.
    islands = _joined(islands, senders, receivers, smooth, _PART_SHARE)
    islands = _joined_by_color(islands, points, colors, spacing)

    sizes = np.bincount(islands)
    centers = np.stack([np.bincount(islands, points[:, axis]) for axis in range(3)], axis=-1) / sizes[:, None]
    order = np.lexsort([*centers.T, -sizes])  # by size, then by place: the order of the particles must not matter
    near_others = np.zeros(len(sizes), dtype=bool)
    near_others[islands[np.r_[senders, receivers][np.tile(islands[senders] != islands[receivers], 2)]]] = True
    enough = np.where(near_others, max(_MIN_PARTICLES, _MIN_SHARE * count), _MIN_PARTICLES)
    large = [island for island in order[:num_bodies] if sizes[island] >= enough[island]] or [order[0]]
    number = np.full(len(sizes), -1, dtype=np.int64)
    number[large] = np.arange(len(large))
    labels = number[islands]
    stray = labels < 0
    if stray.any():
        kept = np.flatnonzero(~stray)
        distance, nearest = cKDTree(points[kept]).query(points[stray])
        joins = labels[kept[nearest]]
        # Noise takes single particles far from everything for moving. One that joined a body would shift its centre.
        lengths = np.array([_length(points[labels == body]) for body in range(len(large))])
        is_far = (sizes[islands[stray]] < _MIN_PARTICLES) & (distance > lengths.clip(_MIN_LENGTH * usual)[joins])
        labels[stray] = np.where(is_far, -1, joins)
    return labels
