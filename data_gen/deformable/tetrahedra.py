"""Tetrahedral meshes from signed distance functions, with NumPy and SciPy alone.

Points on a body-centred cubic lattice inside, points on the surface and on its sharp edges; Delaunay; springs that even
out the distances (the idea of DistMesh, Persson and Strang 2004); at last, with the topology fixed, a search that moves
single points until the worst tetrahedra are good enough. A mesh is only returned when its boundary is a closed surface
without holes or pinches; otherwise other random points are tried.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay

from data_gen.deformable.shapes import Array, Shape, shapes
from vpd_lightning.errors import ConfigError

MIN_QUALITY = 0.15  # of every tetrahedron; 1 is regular, 0 is flat
_NUM_TRIALS = 12
_RELAXATIONS = 30
_MIN_POINTS = 8  # fewer are no body
_LATTICE_JITTER = (1e-3, 0.1)  # share of the spacing, first and later trials: a perfect lattice has no unique mesh
# Lattice points deeper than this share of the spacing stay where they are; shallower ones go to the surface.
_INSIDE = 0.45
_DEPTH = 0.4  # share of the spacing that inner points keep from the surface
_SURFACE_SPACING = 0.72  # distance of surface points, as a share of the lattice's
_EDGE_SPACING = 0.85
_PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
_FACES = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))  # opposite corner i, outward for positive volume


@dataclass(frozen=True)
class TetrahedralMesh:
    """A solid: all tetrahedra have positive volume, every point is used."""

    vertices: NDArray[np.float64]  # (vertex, 3) m
    tetrahedra: NDArray[np.int32]  # (element, 4)

    @property
    def volumes(self) -> Array:
        """Volume of each tetrahedron, m3."""
        return signed_volumes(self.vertices, self.tetrahedra)

    @property
    def boundary(self) -> NDArray[np.int32]:
        """Triangles (face, 3) of the surface, counter-clockwise from outside."""
        return boundary_faces(self.tetrahedra)


def signed_volumes(vertices: Array, tetrahedra: NDArray[np.int32]) -> Array:
    """Return the signed volumes (element,) of tetrahedra in m3; negative where one is inside out."""
    corners = vertices[tetrahedra]
    edges = corners[:, 1:] - corners[:, :1]
    return np.einsum("ei,ei->e", np.cross(edges[:, 0], edges[:, 1]), edges[:, 2]) / 6.0


def quality(vertices: Array, tetrahedra: NDArray[np.int32]) -> Array:
    """Return the mean-ratio quality (element,): 12 (3 V)^(2/3) / sum of squared edges; negative for negative volume."""
    volumes = signed_volumes(vertices, tetrahedra)
    squares = sum(((vertices[tetrahedra[:, a]] - vertices[tetrahedra[:, b]]) ** 2).sum(axis=1) for a, b in _PAIRS)
    return np.sign(volumes) * 12.0 * np.cbrt(3.0 * np.abs(volumes)) ** 2 / squares


def boundary_faces(tetrahedra: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the triangles (face, 3) that belong to one tetrahedron only, pointing outwards."""
    faces = np.concatenate([tetrahedra[:, list(face)] for face in _FACES])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[count == 1])]


def pinched_points(faces: NDArray[np.int32]) -> list[int]:
    """Return the points around which the triangles do not form one closed fan; none on a closed surface."""
    pinched = []
    for point in np.unique(faces):
        corners = np.argwhere(faces == point)
        following = {int(faces[row, (turn + 1) % 3]): int(faces[row, (turn + 2) % 3]) for row, turn in corners}
        start = here = next(iter(following))
        visited = 0
        while here in following:
            here = following.pop(here)
            visited += 1
        if here != start or visited != len(corners):
            pinched.append(int(point))
    return pinched


@cache
def mesh(name: str, spacing: float) -> TetrahedralMesh:
    """Return the mesh of a shape; made once per process.

    Args:
        name: one of ``shapes.shapes()``.
        spacing: side of the lattice cells in m; the distance between neighbouring points is 0.87 of it. Some shapes
            have finer parts and take a share of it.

    Raises:
        ConfigError: the spacing is too coarse for the shape.
    """
    shape = shapes()[name]
    best = 0.0
    for trial in range(_NUM_TRIALS):
        jitter = _LATTICE_JITTER[min(trial, 1)]
        found = _trial(shape, spacing * shape.detail, jitter, np.random.default_rng([trial]))
        if found is None:
            continue
        worst = float(quality(found.vertices, found.tetrahedra).min())
        if worst >= MIN_QUALITY:
            return found
        best = max(best, worst)
    raise ConfigError(
        f"No good mesh of the shape {name} with bodies.spacing={spacing} (worst tetrahedron {best:.2f}, needed "
        f"{MIN_QUALITY}).\nChoose another spacing, for example 0.4."
    )


def _trial(shape: Shape, spacing: float, jitter: float, generator: np.random.Generator) -> TetrahedralMesh | None:
    vertices, num_edge, num_surface = _points(shape, spacing, jitter, generator)
    if len(vertices) < _MIN_POINTS:
        return None
    for _ in range(_RELAXATIONS):
        tetrahedra = _inside_delaunay(shape, vertices, spacing)
        if not len(tetrahedra):
            return None
        vertices = _relax(shape, vertices, tetrahedra, num_edge, num_surface, _DEPTH * spacing)
    tetrahedra = _inside_delaunay(shape, vertices, spacing)
    tetrahedra = _open_pinches(vertices, _peel(vertices, tetrahedra, num_surface))
    used, places = np.unique(tetrahedra, return_inverse=True)
    tetrahedra = places.reshape(-1, 4).astype(np.int32)
    if not len(tetrahedra) or not _is_one_body(tetrahedra):
        return None
    kinds = np.where(used < num_edge, 0, np.where(used < num_surface, 1, 2))
    vertices = vertices[used]
    exposed = np.setdiff1d(boundary_faces(tetrahedra), np.flatnonzero(kinds < 2))  # inner points in dents
    kinds[exposed] = 1
    vertices[exposed] = _project(shape.distance, vertices[exposed])
    vertices = _improve(shape, vertices, tetrahedra, kinds, spacing, generator)
    return TetrahedralMesh(vertices, tetrahedra)


def _points(shape: Shape, spacing: float, jitter: float, generator: np.random.Generator) -> tuple[Array, int, int]:
    """Return points, edge points first, then surface points, then inner ones, and the counts of the first and both."""
    lower, upper = np.asarray(shape.lower) - spacing, np.asarray(shape.upper) + spacing
    counts = np.ceil((upper - lower) / spacing).astype(int)
    start = (lower + upper - counts * spacing) / 2  # symmetric about the box's centre
    axes = [start[axis] + spacing * np.arange(counts[axis] + 1) for axis in range(3)]
    corners = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    lattice = np.concatenate([corners, corners + spacing / 2])
    lattice = lattice + generator.normal(0.0, jitter * spacing, lattice.shape)
    depth = shape.distance(lattice) / np.maximum(np.linalg.norm(_gradient(shape.distance, lattice), axis=1), 1e-3)
    inner = lattice[depth < -_INSIDE * spacing]
    shell = _project(shape.distance, lattice[np.abs(depth) <= _INSIDE * spacing])
    edge = np.concatenate([_resample(line, _EDGE_SPACING * spacing) for line in shape.edges] or [np.empty((0, 3))])
    edge = _thin(edge, np.empty((0, 3)), 0.5 * spacing)
    surface = _thin(shell, edge, _SURFACE_SPACING * spacing)
    return np.concatenate([edge, surface, inner]), len(edge), len(edge) + len(surface)


def _gradient(distance: Callable[[Array], Array], points: Array, step: float = 1e-5) -> Array:
    shifts = np.eye(3) * step
    return np.stack([(distance(points + s) - distance(points - s)) / (2 * step) for s in shifts], axis=-1)


def _project(distance: Callable[[Array], Array], points: Array, iterations: int = 6) -> Array:
    """Move points (point, 3) to the surface by Newton steps along the gradient."""
    for _ in range(iterations):
        gradient = _gradient(distance, points)
        square = np.maximum((gradient**2).sum(axis=1), 1e-6)
        points = points - (distance(points) / square)[:, None] * gradient
    return points


def _resample(line: Array, spacing: float) -> Array:
    """Points at even distances along a polyline, both ends among them."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    places = np.linspace(0.0, lengths[-1], max(2, round(lengths[-1] / spacing) + 1))
    return np.stack([np.interp(places, lengths, line[:, axis]) for axis in range(3)], axis=1)


def _thin(candidates: Array, kept: Array, distance: float) -> Array:
    """Return the candidates that are not nearer than ``distance`` to ``kept`` or to an earlier candidate."""
    chosen: list[Array] = []
    for point in candidates:
        others = np.concatenate([kept, np.reshape(chosen, (-1, 3))])
        if not len(others) or ((others - point) ** 2).sum(axis=1).min() > distance**2:
            chosen.append(point)
    return np.reshape(chosen, (-1, 3))


def _inside_delaunay(shape: Shape, vertices: Array, spacing: float) -> NDArray[np.int32]:
    """Delaunay tetrahedra with their centres inside, positively oriented, without perfectly flat ones."""
    tetrahedra = Delaunay(vertices).simplices
    tetrahedra = tetrahedra[shape.distance(vertices[tetrahedra].mean(axis=1)) < -1e-3 * spacing]
    wrong = signed_volumes(vertices, tetrahedra) < 0
    tetrahedra[wrong] = tetrahedra[wrong][:, [0, 2, 1, 3]]
    return tetrahedra[quality(vertices, tetrahedra) > 1e-3]


def _relax(
    shape: Shape, vertices: Array, tetrahedra: NDArray[np.int32], num_edge: int, num_surface: int, depth: float
) -> Array:
    """One step of springs that only push; edge points stay, surface points stay on the surface, inner ones below it."""
    pairs = np.unique(np.sort(np.concatenate([tetrahedra[:, list(pair)] for pair in _PAIRS]), axis=1), axis=0)
    ends = vertices[pairs[:, 0]] - vertices[pairs[:, 1]]
    lengths = np.linalg.norm(ends, axis=1)
    wanted = 1.12 * np.sqrt((lengths**2).mean())
    push = (np.maximum(wanted - lengths, 0.0) / lengths)[:, None] * ends
    moves = np.zeros_like(vertices)
    np.add.at(moves, pairs[:, 0], push)
    np.add.at(moves, pairs[:, 1], -push)
    moves[:num_edge] = 0.0
    vertices = vertices + 0.15 * moves
    vertices[num_edge:num_surface] = _project(shape.distance, vertices[num_edge:num_surface], 3)
    inner = vertices[num_surface:]
    shallow = shape.distance(inner) > -depth
    inner[shallow] = _project(lambda points: shape.distance(points) + depth, inner[shallow], 2)
    return vertices


def _peel(vertices: Array, tetrahedra: NDArray[np.int32], num_surface: int) -> NDArray[np.int32]:
    """Remove flat tetrahedra of four surface points from the outside: each removal flips one edge of the surface."""
    while True:
        keys = np.sort(np.stack([tetrahedra[:, list(face)] for face in _FACES], axis=1), axis=2)
        _, inverse, count = np.unique(keys.reshape(-1, 3), axis=0, return_inverse=True, return_counts=True)
        exposed = (count[inverse.reshape(-1)] == 1).reshape(-1, 4).sum(axis=1)
        bad = (
            (quality(vertices, tetrahedra) < 2 * MIN_QUALITY) & (exposed == 2) & (tetrahedra < num_surface).all(axis=1)
        )
        if not bad.any():
            return tetrahedra
        worst = np.where(bad, quality(vertices, tetrahedra), np.inf).argmin()
        tetrahedra = np.delete(tetrahedra, worst, axis=0)


def _open_pinches(vertices: Array, tetrahedra: NDArray[np.int32]) -> NDArray[np.int32]:
    """Where the surface touches itself in a point or an edge, remove the worst tetrahedra around."""
    while pinched := pinched_points(boundary_faces(tetrahedra)):
        touching = np.isin(tetrahedra, pinched).sum(axis=1)
        candidates = touching == touching.max()
        grades = np.where(candidates, quality(vertices, tetrahedra), np.inf)
        tetrahedra = np.delete(tetrahedra, grades.argmin(), axis=0)
    return tetrahedra


def _is_one_body(tetrahedra: NDArray[np.int32]) -> bool:
    """Tell whether all triangles of the surface hang together: no crumbs, no hollows."""
    _, places = np.unique(boundary_faces(tetrahedra)[:, [[0, 1], [1, 2]]], return_inverse=True)
    edges = places.reshape(-1, 2)
    size = int(edges.max()) + 1
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(size, size))
    return int(connected_components(graph, directed=False)[0]) == 1


def _improve(
    shape: Shape,
    vertices: Array,
    tetrahedra: NDArray[np.int32],
    kinds: NDArray[np.int64],
    spacing: float,
    generator: np.random.Generator,
    num_moves: int = 1500,
) -> Array:
    """Move single points at random wherever that lifts the worst tetrahedron around them (kind 0 stays, 1 slides)."""
    vertices = vertices.copy()
    around = [np.flatnonzero((tetrahedra == point).any(axis=1)) for point in range(len(vertices))]
    grades = quality(vertices, tetrahedra)
    for _ in range(num_moves):
        worst = int(grades.argmin())
        if grades[worst] > 2 * MIN_QUALITY:
            break
        point = int(generator.choice(tetrahedra[worst]))
        size = spacing * 0.3 * 10.0 ** generator.uniform(-1.5, 0.0)
        shift = generator.normal(0.0, size, 3)
        if kinds[point] == 0:
            continue
        moved = vertices[point] + shift
        if kinds[point] == 1:
            moved = _project(shape.distance, moved[None], 3)[0]
        elif shape.distance(moved[None])[0] > -0.2 * spacing:
            continue
        old = vertices[point].copy()
        before = grades[around[point]].min()
        vertices[point] = moved
        after = quality(vertices, tetrahedra[around[point]])
        if after.min() > before:
            grades[around[point]] = after
        else:
            vertices[point] = old
    return vertices
