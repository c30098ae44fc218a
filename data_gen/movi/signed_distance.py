"""Rounded bodies from blended signed distances, and their surfaces as coarse closed meshes (surface nets).

A distance here is a function of points (..., 3) that is negative inside. The blends and the ellipsoid are approximate
distances, which is enough: the surface is where they vanish. Reference: S. Gibson, "Constrained elastic surface nets",
1998; the polynomial smooth minimum and the ellipsoid bound are those of I. Quilez.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data_gen.movi.mesh import Mesh

_RELAXATIONS = 3

Distance = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def ellipsoid(center: ArrayLike, radii: ArrayLike) -> Distance:
    """An ellipsoid along the axes."""
    middle, sides = np.asarray(center, dtype=np.float64), np.asarray(radii, dtype=np.float64)

    def distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
        scaled = (points - middle) / sides
        outer = np.linalg.norm(scaled, axis=-1)
        inner = np.linalg.norm(scaled / sides, axis=-1)
        return np.asarray(outer * (outer - 1.0) / np.maximum(inner, 1e-9))

    return distance


def limb(start: ArrayLike, end: ArrayLike, start_radius: float, end_radius: float) -> Distance:
    """A rounded stick from ``start`` to ``end`` whose radius changes evenly."""
    origin, along = np.asarray(start, dtype=np.float64), np.subtract(end, start).astype(np.float64)

    def distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
        share = np.clip((points - origin) @ along / float(along @ along), 0.0, 1.0)
        radius = start_radius + share * (end_radius - start_radius)
        return np.asarray(np.linalg.norm(points - origin - share[..., None] * along, axis=-1) - radius)

    return distance


def ring(center: ArrayLike, radius: float, thickness: float, axis: int = 1) -> Distance:
    """A torus around a coordinate axis, of tube radius ``thickness``."""
    middle = np.asarray(center, dtype=np.float64)
    others = [i for i in range(3) if i != axis]

    def distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
        local = points - middle
        circle = np.hypot(local[..., others[0]], local[..., others[1]]) - radius
        return np.asarray(np.hypot(circle, local[..., axis]) - thickness)

    return distance


def mirrored(distance: Distance) -> Distance:
    """The body given for y >= 0, and its mirror image in y."""
    return lambda points: distance(points * [1.0, 0.0, 1.0] + np.abs(points) * [0.0, 1.0, 0.0])


def union(parts: Sequence[Distance], smoothing: float) -> Distance:
    """Blend bodies: fillets about ``smoothing`` wide where they meet."""

    def distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
        result = parts[0](points)
        for part in parts[1:]:
            other = part(points)
            overlap = np.maximum(smoothing - np.abs(result - other), 0.0) / smoothing
            result = np.minimum(result, other) - overlap**2 * (smoothing / 4.0)
        return result

    return distance


def carved(body: Distance, tool: Distance, smoothing: float) -> Distance:
    """Take ``tool`` away from ``body``."""
    outside = union([lambda points: -body(points), tool], smoothing)
    return lambda points: -outside(points)


def surface(distance: Distance, low: ArrayLike, high: ArrayLike, cell: float) -> Mesh:
    """Mesh the zero set of ``distance`` within the box ``low`` to ``high``, on a grid of step ``cell``.

    Surface nets: one vertex in each grid cell that the surface crosses, at the mean of the crossings on the cell's
    edges, evened out and pulled onto the surface; one quadrilateral for each crossed grid edge. Closed by construction
    where the body stays inside the box.

    Raises:
        ValueError: the body is empty or touches the border of the box.
    """
    lowest = np.asarray(low, dtype=np.float64)
    shape = np.ceil((np.asarray(high) - lowest) / cell).astype(int) + 1
    axes = [lowest[i] + cell * np.arange(shape[i]) for i in range(3)]
    values = distance(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    inside = values < 0
    border = any(inside.take(end, axis=axis).any() for axis in range(3) for end in (0, -1))
    if border or not inside.any():
        raise ValueError("the body is empty or does not fit into the box")

    sums, counts = np.zeros((*(shape - 1), 3)), np.zeros(shape - 1)
    crossings = []
    for axis in range(3):
        first = np.moveaxis(np.moveaxis(values, axis, 0)[:-1], 0, axis)
        second = np.moveaxis(np.moveaxis(values, axis, 0)[1:], 0, axis)
        edges = np.argwhere((first < 0) != (second < 0))
        a, b = first[tuple(edges.T)], second[tuple(edges.T)]
        where = edges.astype(np.float64)
        where[:, axis] += a / (a - b)
        others = [(axis + 1) % 3, (axis + 2) % 3]  # so that (axis, others) is right-handed
        cells = np.repeat(edges[:, None], 4, axis=1)
        for corner, (back_0, back_1) in enumerate(((1, 1), (0, 1), (0, 0), (1, 0))):
            cells[:, corner, others[0]] -= back_0
            cells[:, corner, others[1]] -= back_1
            np.add.at(sums, tuple(cells[:, corner].T), where)
            np.add.at(counts, tuple(cells[:, corner].T), 1.0)
        cells[a >= 0] = cells[a >= 0][:, ::-1]  # the surface looks from inside to outside
        crossings.append(cells)

    used = np.argwhere(counts > 0)
    number = np.full(tuple(shape - 1), -1)
    number[tuple(used.T)] = np.arange(len(used))
    vertices = lowest + cell * sums[tuple(used.T)] / counts[tuple(used.T)][:, None]
    quads = np.concatenate([number[tuple(np.moveaxis(cells, -1, 0))] for cells in crossings])
    faces = split_quads(vertices, quads)
    for _ in range(_RELAXATIONS):
        vertices = _pull(distance, _relaxed(vertices, quads), cell)
    return Mesh(_pull(distance, vertices, cell), faces)


def split_quads(vertices: NDArray[np.float64], quads: NDArray[np.int64]) -> NDArray[np.int32]:
    """Cut quadrilaterals (quad, 4) along their shorter diagonal into triangles."""
    a, b, c, d = (vertices[quads[:, i]] for i in range(4))
    short = np.linalg.norm(a - c, axis=1) <= np.linalg.norm(b - d, axis=1) * (1 + 1e-9)
    turned = np.where(short[:, None], quads, np.roll(quads, -1, axis=1))
    return np.concatenate([turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]]).astype(np.int32)


def _relaxed(vertices: NDArray[np.float64], quads: NDArray[np.int64]) -> NDArray[np.float64]:
    """Move vertices half way to the mean of their neighbours, which evens out what the grid left."""
    starts, ends = quads.reshape(-1), np.roll(quads, -1, axis=1).reshape(-1)
    counts = np.bincount(starts, minlength=len(vertices))[:, None]
    sums = np.stack([np.bincount(starts, vertices[ends, i], minlength=len(vertices)) for i in range(3)], axis=1)
    return 0.5 * (vertices + sums / counts)


def _pull(distance: Distance, vertices: NDArray[np.float64], cell: float) -> NDArray[np.float64]:
    """Move vertices towards the surface along its gradient (one step of Newton), by less than half a cell."""
    step = 1e-3 * cell
    slope = np.stack(
        [distance(vertices + step * axis) - distance(vertices - step * axis) for axis in np.eye(3)], axis=-1
    )
    slope /= 2 * step
    offset = -(distance(vertices) / np.maximum((slope**2).sum(axis=-1), 0.25))[:, None] * slope
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    return vertices + offset * np.minimum(1.0, 0.45 * cell / np.maximum(length, 1e-12))
