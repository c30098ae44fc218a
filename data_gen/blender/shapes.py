"""MuJoCo's primitive shapes as triangles, with the coordinates that its renderer looks textures up with.

``chart`` is where a corner lies in a flat texture that covers the shape once: u to the right, v down the rows, as
MuJoCo 4 lays it (around the z axis and downwards on round shapes, each face of a box on its own).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_AROUND = 96  # corners of a circle; a chord lies at most 0.05 % of the radius inside it
_QUADS = 32  # per edge of the cube that a sphere is blown up from; even, so that edges lie on the equator

Floats = NDArray[np.float64]
Faces = NDArray[np.int32]


@dataclass(frozen=True)
class Triangles:
    """A triangle mesh with attributes per corner."""

    vertices: Floats  # (vertex, 3), m
    faces: Faces  # (face, 3), counter-clockwise from outside
    normals: Floats  # (face * 3, 3), shading normal at each corner
    unit: Floats  # (face * 3, 3), corner in the unit shape that MuJoCo scales: the direction into a cube texture
    chart: Floats  # (face * 3, 2), times the number of repeats ...
    shift: tuple[float, float] = (0.0, 0.0)  # ... plus this, gives texture coordinates


def box(size: Floats) -> Triangles:
    """A box with half sizes ``size``; faces in the order +x -x +y -y +z -z, two triangles each."""
    corners: list[Floats] = []
    faces: list[NDArray[np.int64]] = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            face = np.zeros((4, 3))
            face[:, axis] = sign
            face[:, (axis + 1) % 3] = [-1, 1, 1, -1]
            face[:, (axis + 2) % 3] = [-1, -1, 1, 1]
            quad = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * len(corners)
            corners.append(face)
            faces.append(quad if sign > 0 else quad[:, ::-1])
    unit = np.concatenate(corners)
    triangles = np.concatenate(faces).astype(np.int32)
    at = unit[triangles.ravel()]
    across = np.repeat([1, 0, 0], 12), np.repeat([2, 2, 1], 12)  # which axes u and v follow on x, y and z faces
    row = np.arange(len(at))
    chart = np.stack([at[row, across[0]] + 1, 1 - at[row, across[1]]], axis=1) / 2
    return Triangles(unit * size, triangles, face_normals(unit, triangles), at, chart)


def plane(half_width: float, half_height: float) -> Triangles:
    """A rectangle in the plane z = 0, seen from above."""
    unit = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    at = unit[faces.ravel()]
    chart = at[:, :2] * [0.5, -0.5] + 0.5
    return Triangles(unit * [half_width, half_height, 1.0], faces, face_normals(unit, faces), at, chart)


def ellipsoid(size: Floats) -> Triangles:
    """An ellipsoid with radii ``size`` (three equal ones: a sphere); unit shape: radius 1."""
    unit, faces = _ball()
    at = unit[faces.ravel()]
    normals = _unit_length(unit / size)[faces.ravel()]
    chart = np.stack([_around(at), 0.5 - _elevation(at) / np.pi], axis=1)
    return Triangles(unit * size, faces, normals, at, chart)


def cylinder(radius: float, half_height: float) -> Triangles:
    """A cylinder along z with flat caps; unit shape: radius 1, z from -1 to 1."""
    angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(_AROUND)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    unit = np.concatenate([ring - up, ring + up, [-up, up]])
    here = np.arange(_AROUND)
    following = (here + 1) % _AROUND
    side = _band(here, following, _AROUND)
    bottom = np.stack([following, here, np.full(_AROUND, 2 * _AROUND)], axis=1)
    top = np.stack([here + _AROUND, following + _AROUND, np.full(_AROUND, 2 * _AROUND + 1)], axis=1)
    faces = np.concatenate([side, bottom, top]).astype(np.int32)
    at = unit[faces.ravel()]
    is_side = np.repeat([True, False], [3 * len(side), 6 * _AROUND])
    normals = np.where(is_side[:, None], at * [1, 1, 0], at * [0, 0, 1])
    chart = np.where(
        is_side[:, None], np.stack([_around(at * [1, 1, 0]), (1 - at[:, 2]) / 2], axis=1), (at[:, :2] + 1) / 2
    )
    return Triangles(unit * [radius, radius, half_height], faces, normals, at, chart)


def capsule(radius: float, half_height: float) -> Triangles:
    """A cylinder along z, half spheres beyond its ends: a ball that is pulled apart at its equator."""
    ball, faces = _ball()
    count = len(ball)
    is_upper = ball[faces].mean(axis=1)[:, 2] > 0
    equator = np.flatnonzero(np.abs(ball[:, 2]) < 1e-9)
    equator = equator[np.argsort(np.arctan2(ball[equator, 1], ball[equator, 0]))]
    side = _band(equator, np.roll(equator, -1), count)
    faces = np.concatenate([np.where(is_upper[:, None], faces + count, faces), side]).astype(np.int32)
    apart = np.array([0.0, 0.0, half_height])
    vertices = np.concatenate([ball * radius - apart, ball * radius + apart])
    normals = np.concatenate([ball, ball])[faces.ravel()]
    z = vertices[faces.ravel(), 2]
    rise = np.abs(_elevation(normals)) / (np.pi / 2)
    part = np.repeat(np.concatenate([is_upper.astype(int), np.full(len(side), 2)]), 3)
    v = np.choose(part, [rise, 1 - rise, (1 - z / half_height) / 2])
    unit = vertices[faces.ravel()] / [radius, radius, half_height + radius]
    return Triangles(vertices, faces, normals, unit, np.stack([_around(normals), v], axis=1))


def from_mesh(vertices: Floats, faces: Faces, normals: Floats, size: Floats) -> Triangles:
    """A mesh with half sizes ``size``; a flat texture is projected along z."""
    unit = vertices[faces.ravel()] / np.where(size > 0, size, 1.0)
    return Triangles(vertices, faces, normals, unit, unit[:, :2] * [0.5, -0.5], (-0.5, -0.5))


def _ball() -> tuple[Floats, Faces]:
    """A unit sphere from a cube of quads: even triangles, few at the poles."""
    steps = np.tan(np.linspace(-np.pi / 4, np.pi / 4, _QUADS + 1))  # equal angles between the rows
    steps[_QUADS // 2] = 0.0
    u, v = np.meshgrid(steps, steps, indexing="ij")
    grid = np.arange((_QUADS + 1) ** 2).reshape(_QUADS + 1, _QUADS + 1)
    a, b, c, d = grid[:-1, :-1].ravel(), grid[1:, :-1].ravel(), grid[1:, 1:].ravel(), grid[:-1, 1:].ravel()
    quads = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    points: list[Floats] = []
    faces: list[NDArray[np.int64]] = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            side = np.zeros((grid.size, 3))
            side[:, axis] = sign
            side[:, (axis + 1) % 3], side[:, (axis + 2) % 3] = u.ravel(), v.ravel()
            faces.append((quads if sign > 0 else quads[:, ::-1]) + grid.size * len(points))
            points.append(side)
    rounded = np.round(_unit_length(np.concatenate(points)), 12) + 0.0  # no -0.0, which would stay apart from 0.0
    vertices, index = np.unique(rounded, axis=0, return_inverse=True)
    return _unit_length(vertices), index.reshape(-1)[np.concatenate(faces)].astype(np.int32)


def _band(lower: NDArray[np.int64], following: NDArray[np.int64], above: int) -> NDArray[np.int64]:
    """Join a ring of vertices to its copy, whose indices are higher by ``above``."""
    first = np.stack([lower, following, following + above], axis=1)
    return np.concatenate([first, np.stack([lower, following + above, lower + above], axis=1)])


def _around(corners: Floats) -> Floats:
    """Return the turn about z, 0 to 1, of corners (three to a face) so that no face straddles the seam."""
    x, y = corners[:, 0].reshape(-1, 3), corners[:, 1].reshape(-1, 3)
    turn = np.arctan2(y, x) / (2 * np.pi) % 1.0
    is_pole = np.hypot(x, y) < 1e-9
    low = np.where(is_pole, 1.0, turn).min(axis=1, keepdims=True)
    high = np.where(is_pole, 0.0, turn).max(axis=1, keepdims=True)
    turn = np.where((high - low > 0.5) & (turn < 0.5), turn + 1, turn)
    others = np.where(is_pole, 0.0, turn).sum(axis=1, keepdims=True) / (~is_pole).sum(axis=1, keepdims=True)
    return np.where(is_pole, others, turn).ravel()


def _elevation(directions: Floats) -> Floats:
    return np.arctan2(directions[:, 2], np.hypot(directions[:, 0], directions[:, 1]))


def face_normals(vertices: Floats, faces: Faces) -> Floats:
    """Return the unit normal of each face at its three corners, (face * 3, 3)."""
    corners = vertices[faces]
    return np.repeat(_unit_length(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])), 3, axis=0)


def _unit_length(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
