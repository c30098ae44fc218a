"""Stand-ins for the three modelled shapes of KuBasic: a cow for Spot, a teapot, and a monkey's head for Suzanne.

The originals are modelled by hand and are not shipped here. These are blended ellipsoids and sticks of the same kind
and size; whoever needs the originals brings their meshes. Each figure is a list of named bodies, because what is convex
enough to collide follows them.
"""

from dataclasses import dataclass

import numpy as np

from data_gen.movi.signed_distance import Distance, carved, ellipsoid, limb, mirrored, ring, union


@dataclass(frozen=True)
class Figure:
    """Blended bodies.

    Attributes:
        whole: the distance whose surface is seen.
        bodies: what collides: the hull of the surface points nearest to each.
        low: corner of a box around the figure.
        high: the opposite corner.
        cell: grid step; these give about 1,650 faces each.
    """

    whole: Distance
    bodies: tuple[Distance, ...]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    cell: float


def spot() -> Figure:
    """A cow, looking along +x, 2 long."""
    trunk = ellipsoid((-0.1, 0, 0), (0.7, 0.38, 0.38))
    chest = ellipsoid((0.3, 0, 0.06), (0.34, 0.32, 0.38))
    neck = limb((0.4, 0, 0.2), (0.7, 0, 0.5), 0.24, 0.22)
    head = union([neck, ellipsoid((0.8, 0, 0.52), (0.26, 0.23, 0.24))], 0.1)
    snout = ellipsoid((1.02, 0, 0.42), (0.2, 0.2, 0.16))
    ears = mirrored(ellipsoid((0.68, 0.34, 0.56), (0.1, 0.2, 0.1)))
    horns = mirrored(limb((0.76, 0.12, 0.66), (0.8, 0.2, 0.92), 0.11, 0.09))
    front = mirrored(limb((0.34, 0.19, -0.1), (0.36, 0.2, -0.68), 0.15, 0.13))
    back = mirrored(limb((-0.54, 0.19, -0.1), (-0.56, 0.2, -0.68), 0.18, 0.13))
    tail = limb((-0.74, 0, 0.14), (-0.92, 0, -0.3), 0.09, 0.11)
    udder = ellipsoid((-0.32, 0, -0.34), (0.2, 0.18, 0.14))
    whole = union([trunk, chest, head, snout, front, back, udder, tail, ears, horns], 0.14)
    bodies = (
        union([trunk, chest, udder], 0.05),
        union([head, snout], 0.05),
        union([horns, ears], 0.05),
        tail,
        *(_half(pair, side) for pair in (front, back) for side in (-1, 1)),
    )
    return Figure(whole, bodies, (-1.2, -0.7, -0.95), (1.4, 0.7, 1.15), 0.106)


def teapot() -> Figure:
    """A teapot, spout along +x, 2.2 long."""
    belly = ellipsoid((0, 0, 0), (0.66, 0.66, 0.5))
    foot = ellipsoid((0, 0, -0.42), (0.44, 0.44, 0.14))
    lid = ellipsoid((0, 0, 0.46), (0.42, 0.42, 0.14))
    knob = ellipsoid((0, 0, 0.7), (0.15, 0.15, 0.14))
    handle = ring((-0.7, 0, 0.06), 0.36, 0.11, axis=1)
    spout = union(
        [limb((0.5, 0, -0.18), (0.84, 0, 0.08), 0.24, 0.16), limb((0.84, 0, 0.08), (1.06, 0, 0.44), 0.16, 0.13)], 0.08
    )
    whole = union([belly, foot, lid, knob, spout, handle], 0.07)
    return Figure(
        whole, (union([belly, foot], 0.05), lid, knob, handle, spout), (-1.35, -0.85, -0.8), (1.4, 0.85, 1.05), 0.112
    )


def suzanne() -> Figure:
    """A monkey's head, looking along +x, 2 wide from ear to ear."""
    skull = ellipsoid((-0.12, 0, 0.2), (0.66, 0.6, 0.58))
    brow = limb((0.46, -0.34, 0.44), (0.46, 0.34, 0.44), 0.15, 0.15)
    cheeks = mirrored(ellipsoid((0.3, 0.28, -0.14), (0.3, 0.28, 0.28)))
    muzzle = union(
        [ellipsoid((0.5, 0, -0.34), (0.32, 0.36, 0.24)), ellipsoid((0.34, 0, -0.56), (0.28, 0.26, 0.2))], 0.1
    )
    nose = ellipsoid((0.66, 0, -0.1), (0.17, 0.2, 0.16))
    face = union([skull, cheeks, muzzle, brow, nose], 0.2)
    sockets = mirrored(ellipsoid((0.72, 0.3, 0.16), (0.22, 0.2, 0.16)))
    eyes = mirrored(ellipsoid((0.52, 0.28, 0.17), (0.17, 0.17, 0.17)))
    ear = mirrored(ellipsoid((-0.14, 0.78, 0.24), (0.17, 0.32, 0.36)))
    dish = mirrored(ellipsoid((0.12, 0.82, 0.26), (0.2, 0.22, 0.25)))
    whole = union([carved(face, sockets, 0.12), eyes, carved(ear, dish, 0.12)], 0.1)
    ears = tuple(_half(ear, side) for side in (-1, 1))
    bodies = (union([skull, brow], 0.05), union([cheeks, muzzle, nose], 0.05), *ears)
    return Figure(whole, bodies, (-1.0, -1.3, -1.0), (1.2, 1.3, 1.05), 0.118)


def _half(pair: Distance, side: int) -> Distance:
    """One of two mirrored bodies: the other half is far away."""
    return lambda points: np.where(points[..., 1] * side >= 0, pair(points), 1e3)
