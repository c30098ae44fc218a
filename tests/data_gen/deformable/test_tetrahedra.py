import math

import numpy as np
import pytest

from data_gen.deformable.shapes import CYLINDER_RADIUS, DONUT_RADIUS, ICOSAHEDRON_RADIUS, TUBE_RADIUS, shapes
from data_gen.deformable.tetrahedra import MIN_QUALITY, TetrahedralMesh, mesh, pinched_points, quality
from vpd_lightning.errors import ConfigError

SPACING = 0.42  # of the paper presets, m
VOLUMES = {  # m3, closed forms
    "cube": 8.0,
    "cylinder": 2 * math.pi * CYLINDER_RADIUS**2,
    "donut": 2 * math.pi**2 * DONUT_RADIUS * TUBE_RADIUS**2,
    "icosahedron": 5 / 12 * (3 + math.sqrt(5)) * (ICOSAHEDRON_RADIUS / math.sin(2 * math.pi / 5)) ** 3,
    "ball": 4 / 3 * math.pi,
}
NAMES = sorted(shapes())
REGULAR = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


def volume_of(name: str) -> float:
    """Closed form; for the duck, cells of 2.5 cm whose centre is inside."""
    if name in VOLUMES:
        return VOLUMES[name]
    shape, side = shapes()[name], 0.025
    axes = [np.arange(low + side / 2, high, side) for low, high in zip(shape.lower, shape.upper, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    return float((shape.distance(points) < 0).sum() * side**3)


def test_meshes_fill_their_shapes(name: str):
    """Chords cut off some of a round body: at most a tenth at this spacing, nothing where all faces are flat."""
    share = mesh(name, SPACING).volumes.sum() / volume_of(name)

    assert share == pytest.approx(1.0, abs=1e-9) if name in ("cube", "icosahedron") else 0.9 < share < 1.0


def test_tetrahedra_are_positive_and_far_from_flat(name: str):
    body = mesh(name, SPACING)

    assert body.volumes.min() > 1e-3 * SPACING**3
    assert quality(body.vertices, body.tetrahedra).min() >= MIN_QUALITY
    assert len(np.unique(np.sort(body.tetrahedra, axis=1), axis=0)) == len(body.tetrahedra)
    assert 80 < len(body.vertices) < 300


def test_surfaces_are_closed(name: str):
    """Each edge has exactly two triangles, in opposite directions; the genus is the shape's."""
    body = mesh(name, SPACING)
    faces = body.boundary
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, count = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)

    assert (count == 2).all()
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert pinched_points(faces) == []
    euler = len(np.unique(faces)) - len(directed) // 2 + len(faces)
    assert euler == (0 if name == "donut" else 2)
    corners = body.vertices[faces]  # the divergence theorem: outward faces enclose the tetrahedra's volume
    enclosed = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert enclosed == pytest.approx(body.volumes.sum(), rel=1e-9)


def test_surface_points_lie_on_the_shape(name: str):
    body, shape = mesh(name, SPACING), shapes()[name]

    assert np.abs(shape.distance(body.vertices[np.unique(body.boundary)])).max() < 1e-6
    assert shape.distance(body.vertices).max() < 1e-6


def test_sharp_corners_are_kept():
    body = mesh("cube", SPACING)
    corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3)

    for corner in corners:
        assert np.abs(body.vertices - corner).max(axis=1).min() < 1e-9


@pytest.mark.parametrize(("name", "spacing"), [("duck", 0.38), ("duck", 0.5), ("cylinder", 0.5)])  # the hardest two
def test_other_spacings_give_good_meshes(name: str, spacing: float):
    body = mesh(name, spacing)

    assert quality(body.vertices, body.tetrahedra).min() >= MIN_QUALITY
    assert pinched_points(body.boundary) == []


def test_too_coarse_meshes_are_refused():
    with pytest.raises(ConfigError, match=r"No good mesh of the shape donut with bodies.spacing=2.0"):
        mesh("donut", 2.0)


def test_meshes_are_the_same_every_time():
    again = mesh.__wrapped__("ball", SPACING)  # without the cache

    assert (again.vertices == mesh("ball", SPACING).vertices).all()
    assert (again.tetrahedra == mesh("ball", SPACING).tetrahedra).all()


def test_quality_is_one_for_the_regular_tetrahedron_and_negative_inside_out():
    order = np.array([[0, 1, 2, 3], [0, 2, 1, 3]], np.int32)
    grades = quality(REGULAR, order)

    np.testing.assert_allclose(np.abs(grades), 1.0, rtol=1e-12)
    assert grades[0] == -grades[1]


def test_touching_bodies_are_pinched():
    """Two tetrahedra that share one point, and two that share one edge."""
    corner = TetrahedralMesh(np.zeros((7, 3)), np.array([[0, 1, 2, 3], [0, 4, 5, 6]], np.int32))
    edge = TetrahedralMesh(np.zeros((6, 3)), np.array([[0, 1, 2, 3], [0, 1, 4, 5]], np.int32))

    assert pinched_points(corner.boundary) == [0]
    assert pinched_points(edge.boundary) == [0, 1]
