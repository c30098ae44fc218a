"""The eleven shapes of the MOVi-A and MOVi-B objects, made of formulas, and what of them collides.

Eight are the shapes of Kubric's KuBasic set by their definition (cube, cylinder, sphere, cone, torus, gear, torus knot,
sponge); proportions of gear, knot and sponge are ours. Spot, teapot and suzanne are stand-ins (see ``figures``).
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from data_gen.movi import figures
from data_gen.movi.collision_parts import CollisionPart, capsule, hull
from data_gen.movi.mesh import Mesh
from data_gen.movi.signed_distance import surface
from data_gen.movi.sweeps import pierced_prism, revolution, tube, voxel_mesh

SHAPES = (
    "cube", "cylinder", "sphere", "cone", "torus", "gear", "torus_knot", "sponge", "spot", "teapot", "suzanne",
)  # fmt: skip

_SECTIONS = 48  # corners of the circles of cylinder and cone; a multiple of 4 keeps the bounding box exact
_TORUS_RADIUS, _TORUS_TUBE = 0.375, 0.125
_KNOT_TUBE = 0.55  # of a trefoil whose loops reach out to 3
_GEAR_TEETH, _GEAR_ROOT, _GEAR_HOLE, _GEAR_HEIGHT = 12, 0.39, 0.14, 0.28
_GEAR_FOOT, _GEAR_TIP = 0.58, 0.36  # half the width of a tooth at its foot and its tip, of half a tooth's angle
_NUM_CAPSULES = 16
_FIGURES = {"spot": figures.spot, "teapot": figures.teapot, "suzanne": figures.suzanne}


@cache
def shape_mesh(name: str) -> Mesh:
    """Return a shape: bounding box centred on the origin, longest side 1, closed, with shading normals.

    Raises:
        ValueError: no such shape.
    """
    if name not in SHAPES:
        raise ValueError(f"no shape named {name!r}; there are {', '.join(SHAPES)}")
    return _raw(name).normalized().shaded(crease=180.0 if name in _FIGURES else 40.0)


@cache
def collision_parts(name: str) -> tuple[CollisionPart, ...]:
    """Return what of ``shape_mesh(name)`` collides, in the same frame and units.

    Cube, cylinder, sphere and cone collide as they are. Elsewhere the visible surface sticks out of what collides by
    at most (thousandths of the longest side) 4 (torus) and 19 (torus knot), and what collides bulges beyond the
    visible surface by at most 4 (torus), 19 (torus knot), 38 (suzanne), 53 (spot), 66 (teapot, in its handle),
    140 (gear, in its hole) and 236 (sponge, in its holes). The tests measure it.
    """
    mesh = shape_mesh(name)
    if name == "cube":
        return (CollisionPart("box", (0.5, 0.5, 0.5)),)
    if name == "sponge":
        return (CollisionPart("box", (0.5, 0.5, 0.5)),)
    if name == "sphere":
        return (CollisionPart("sphere", (0.5,)),)
    if name == "cylinder":
        return (CollisionPart("cylinder", (0.5, 0.5)),)
    if name == "torus":
        return _chain(_circle, _TORUS_TUBE, mesh)
    if name == "torus_knot":
        return _chain(_knot, _KNOT_TUBE, _raw(name))
    if name == "gear":
        return _gear_parts()
    if name in _FIGURES:
        return _figure_parts(name)
    return (hull(mesh.vertices),)


def _raw(name: str) -> Mesh:
    if name == "cube":
        return voxel_mesh(np.ones((1, 1, 1), dtype=bool))
    if name == "sponge":
        hole = np.add.outer(np.add.outer([0, 1, 0], [0, 1, 0]), [0, 1, 0]) >= 2
        return voxel_mesh(np.kron(~hole, ~hole).astype(bool))
    if name == "cylinder":
        return revolution([(0, -0.5), (0.5, -0.5), (0.5, 0.5), (0, 0.5)], _SECTIONS)
    if name == "cone":
        return revolution([(0, -0.5), (0.5, -0.5), (0, 0.5)], _SECTIONS)
    if name == "sphere":
        angle = np.linspace(-np.pi / 2, np.pi / 2, 21)
        return revolution(np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle)], axis=1), 40)
    if name == "torus":
        angle = 2 * np.pi * np.arange(40) / 40
        return tube(_circle(angle), _TORUS_TUBE, 16)
    if name == "torus_knot":
        return tube(_knot(2 * np.pi * np.arange(72) / 72), _KNOT_TUBE, 10)
    if name == "gear":
        return _gear()
    figure = _FIGURES[name]()
    return surface(figure.whole, figure.low, figure.high, figure.cell)


def _circle(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return _TORUS_RADIUS * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


def _knot(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """A trefoil, three loops around z."""
    return np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=1)


def _gear() -> Mesh:
    half = np.pi / _GEAR_TEETH
    center = 2 * half * np.arange(_GEAR_TEETH)[:, None]
    angle = (center + half * np.array([-_GEAR_FOOT, -_GEAR_TIP, _GEAR_TIP, _GEAR_FOOT])).reshape(-1)
    radius = np.tile([_GEAR_ROOT, 0.5, 0.5, _GEAR_ROOT], _GEAR_TEETH)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return pierced_prism(radius[:, None] * circle, _GEAR_HOLE * circle, _GEAR_HEIGHT)


def _gear_parts() -> tuple[CollisionPart, ...]:
    """A disc up to the teeth's feet, and one convex tooth after the other."""
    mesh, half = shape_mesh("gear"), np.pi / _GEAR_TEETH
    angle = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0])
    far = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1]) > 0.5 * (_GEAR_HOLE + _GEAR_ROOT)
    height = float(mesh.bounds[1, 2])
    parts = [CollisionPart("cylinder", (_GEAR_ROOT * 2 * height / _GEAR_HEIGHT, height))]
    for tooth in range(_GEAR_TEETH):
        away = np.angle(np.exp(1j * (angle - 2 * half * tooth)))
        parts.append(hull(mesh.vertices[far & (np.abs(away) < half)]))
    return tuple(parts)


def _chain(
    curve: Callable[[NDArray[np.float64]], NDArray[np.float64]], radius: float, raw: Mesh
) -> tuple[CollisionPart, ...]:
    """Capsules along a closed curve that ``raw`` was swept along, in the frame of the normalised mesh.

    Their ends are moved outwards by half of what a chord would cut off, so that the error is shared.
    """
    step = 2 * np.pi / _NUM_CAPSULES
    t = np.asarray(step * np.arange(_NUM_CAPSULES), dtype=np.float64)
    on_curve = curve(t)
    cut_off = on_curve - 0.5 * (curve(t - step / 2) + curve(t + step / 2))
    factor = 1.0 / float(raw.extents.max())
    points: NDArray[np.float64] = (on_curve + 0.5 * cut_off - raw.bounds.mean(axis=0)) * factor
    ends = zip(points, np.roll(points, -1, axis=0), strict=True)
    return tuple(capsule(start, end, radius * factor) for start, end in ends)


def _figure_parts(name: str) -> tuple[CollisionPart, ...]:
    """The hulls of the faces nearest to each body of the figure."""
    figure = _FIGURES[name]()
    raw = surface(figure.whole, figure.low, figure.high, figure.cell)
    nearest = np.argmin([body(raw.vertices) for body in figure.bodies], axis=0)
    middle, factor = raw.bounds.mean(axis=0), 1.0 / float(raw.extents.max())
    parts = []
    for body in range(len(figure.bodies)):
        faces = raw.faces[(nearest[raw.faces] == body).any(axis=1)]
        parts.append(hull((raw.vertices[np.unique(faces)] - middle) * factor))
    return tuple(parts)
