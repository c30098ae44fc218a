"""Signed distance functions of the six soft bodies; each body is about 2 m across, centred on the origin.

A function takes points (..., 3) in metres and returns (...): negative inside, zero on the surface. Near the surface it
grows in proportion to the distance; exact distances are not needed. Sharp edges are listed as polylines, because a mesh
that does not put points on them rounds them off.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

Array = NDArray[np.float64]

CYLINDER_RADIUS = 0.9  # m
DONUT_RADIUS = 0.9  # m, of the circle inside the tube
TUBE_RADIUS = 0.42  # m
ICOSAHEDRON_RADIUS = 1.15  # m, centre to corner
DUCK_BODY = ((0.0, 0.0, -0.2), (1.0, 0.72, 0.62))  # centre and half axes of an ellipsoid, m
DUCK_TAIL = ((-0.92, 0.0, 0.18), (0.36, 0.34, 0.27))
DUCK_HEAD = ((0.55, 0.0, 0.65), (0.52, 0.50, 0.50))
DUCK_BEAK = ((1.05, 0.0, 0.58), (0.30, 0.30, 0.17))


@dataclass(frozen=True)
class Shape:
    """A closed body given by its signed distance function."""

    name: str
    distance: Callable[[Array], Array]
    lower: tuple[float, float, float]  # a box around the body, m
    upper: tuple[float, float, float]
    edges: tuple[Array, ...] = ()  # sharp edges as polylines (point, 3); their ends are corners
    has_flat_faces: bool = False  # shaded with one normal per triangle, so that edges look crisp (geometry is the same)
    detail: float = 1.0  # share of the usual distance between mesh points that this shape needs


def cube(points: Array) -> Array:
    """Side 2 m."""
    return np.abs(points).max(axis=-1) - 1.0


def cylinder(points: Array) -> Array:
    """Upright, 2 m high."""
    return np.maximum(np.hypot(points[..., 0], points[..., 1]) - CYLINDER_RADIUS, np.abs(points[..., 2]) - 1.0)


def donut(points: Array) -> Array:
    """A lying torus."""
    return np.hypot(np.hypot(points[..., 0], points[..., 1]) - DONUT_RADIUS, points[..., 2]) - TUBE_RADIUS


def icosahedron(points: Array) -> Array:
    """Twenty planes."""
    hull = _icosahedron_hull()
    return (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=-1)


def duck(points: Array) -> Array:
    """A bath duck of blended ellipsoids: body, tail, head, beak; it looks along +x."""
    distance = _ellipsoid(points, *DUCK_BODY)
    distance = _blend(distance, _ellipsoid(points, *DUCK_TAIL), 0.25)
    distance = _blend(distance, _ellipsoid(points, *DUCK_HEAD), 0.18)
    return _blend(distance, _ellipsoid(points, *DUCK_BEAK), 0.08)


def ball(points: Array) -> Array:
    """Radius 1 m."""
    return np.linalg.norm(points, axis=-1) - 1.0


@cache
def shapes() -> dict[str, Shape]:
    """Return all shapes by name."""
    tube = DONUT_RADIUS + TUBE_RADIUS
    known = (
        Shape("cube", cube, (-1.0,) * 3, (1.0,) * 3, _cube_edges(), has_flat_faces=True),
        Shape(
            "cylinder",
            cylinder,
            (-CYLINDER_RADIUS, -CYLINDER_RADIUS, -1.0),
            (CYLINDER_RADIUS, CYLINDER_RADIUS, 1.0),
            (_circle(-1.0), _circle(1.0)),
        ),
        Shape("donut", donut, (-tube, -tube, -TUBE_RADIUS), (tube, tube, TUBE_RADIUS), detail=0.85),
        Shape(
            "icosahedron",
            icosahedron,
            (-ICOSAHEDRON_RADIUS,) * 3,
            (ICOSAHEDRON_RADIUS,) * 3,
            _icosahedron_edges(),
            has_flat_faces=True,
        ),
        Shape("duck", duck, (-1.4, -0.8, -0.9), (1.4, 0.8, 1.25), detail=0.8),
        Shape("ball", ball, (-1.0,) * 3, (1.0,) * 3),
    )
    return {shape.name: shape for shape in known}


def _ellipsoid(points: Array, center: tuple[float, ...], half_axes: tuple[float, ...]) -> Array:
    scaled = (points - np.asarray(center)) / np.asarray(half_axes)
    return (np.linalg.norm(scaled, axis=-1) - 1.0) * min(half_axes)


def _blend(first: Array, second: Array, width: float) -> Array:
    """Union with a rounded seam (the polynomial smooth minimum)."""
    share = np.clip(0.5 + 0.5 * (second - first) / width, 0.0, 1.0)
    return second * (1 - share) + first * share - width * share * (1 - share)


def _cube_edges() -> tuple[Array, ...]:
    edges = []
    for axis in range(3):
        for sides in ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)):
            ends = np.array([np.insert(sides, axis, end) for end in (-1.0, 1.0)])
            edges.append(ends)
    return tuple(edges)


def _circle(height: float, num_points: int = 360) -> Array:
    angle = np.linspace(0.0, 2 * math.pi, num_points + 1)
    return np.stack(
        [CYLINDER_RADIUS * np.cos(angle), CYLINDER_RADIUS * np.sin(angle), np.full_like(angle, height)], axis=1
    )


@cache
def _icosahedron_hull() -> ConvexHull:
    golden = (1 + math.sqrt(5)) / 2
    corners = [
        np.roll([0.0, first, second * golden], turn)
        for turn in range(3)
        for first in (-1.0, 1.0)
        for second in (-1.0, 1.0)
    ]
    return ConvexHull(np.array(corners) * ICOSAHEDRON_RADIUS / math.hypot(1.0, golden))


def _icosahedron_edges() -> tuple[Array, ...]:
    hull = _icosahedron_hull()
    pairs = {tuple(sorted((face[i], face[i - 1]))) for face in hull.simplices for i in range(3)}
    return tuple(hull.points[list(pair)] for pair in sorted(pairs))
