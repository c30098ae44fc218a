import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from data_gen.movi import shapes
from data_gen.movi.collision_parts import CollisionPart, capsule, hull, rotation_matrix
from data_gen.movi.mesh import Mesh
from data_gen.movi.shapes import SHAPES, collision_parts, shape_mesh
from data_gen.movi.signed_distance import ellipsoid, surface


def points_on(mesh: Mesh, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random points on a mesh, evenly by area, and the faces that they lie on."""
    generator = np.random.default_rng(seed)
    areas = np.linalg.norm(mesh.face_vectors, axis=1)
    face = generator.choice(len(areas), count, p=areas / areas.sum())
    u, v = np.sort(generator.random((2, count)), axis=0)
    a, b, c = mesh.corners
    return a[face] * u[:, None] + b[face] * (v - u)[:, None] + c[face] * (1 - v)[:, None], face


def standoff(name: str) -> tuple[float, float]:
    """How far the visible surface sticks out of what collides, and how far what collides bulges beyond it.

    Rays would be exact; here points of the visible surface against the parts' signed distance, and points of space
    between visible and colliding surface against the visible one, which is good to about a hundredth.
    """
    mesh, parts = shape_mesh(name), collision_parts(name)
    seen, _ = points_on(mesh, 8_000)
    union = np.min([part.distance(seen) for part in parts], axis=0)
    axes = np.linspace(-0.5, 0.5, 33)
    space = np.stack(np.meshgrid(axes, axes, axes, indexing="ij"), axis=-1).reshape(-1, 3)
    space = space[np.min([part.distance(space) for part in parts], axis=0) <= 0]
    # A point is outside of the visible body when its nearest visible point looks towards it.
    normals = mesh.face_vectors / np.linalg.norm(mesh.face_vectors, axis=1, keepdims=True)
    dense, face = points_on(mesh, 40_000, seed=1)
    gap, nearest = cKDTree(dense).query(space)
    outside = np.einsum("ni,ni->n", space - dense[nearest], normals[face[nearest]]) > 0
    return float(union.max()), float(gap[outside].max(initial=0.0))


@pytest.mark.parametrize("name", SHAPES)
def test_shape_is_closed_outward_and_normalised(name: str):
    mesh = shape_mesh(name)

    assert mesh.is_closed
    assert mesh.volume > 0.02
    assert mesh.bounds.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-12)
    assert mesh.extents.max() == pytest.approx(1.0, abs=1e-12)
    assert len(mesh.faces) <= (2112 if name == "sponge" else 1700)
    assert mesh.normals is not None
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1.0)
    assert mesh.faces.max() < len(mesh.vertices)


def test_volumes_are_those_of_the_formulas():
    assert shape_mesh("cube").volume == pytest.approx(1.0, rel=1e-12)
    polygon = 24 * np.sin(2 * np.pi / 48) * 0.25  # area of the circle's 48-gon
    assert shape_mesh("cylinder").volume == pytest.approx(polygon, rel=1e-9)
    assert shape_mesh("cone").volume == pytest.approx(polygon / 3, rel=1e-9)
    # Inscribed polyhedra: below the smooth body by the order of (half a step)^2.
    assert shape_mesh("sphere").volume == pytest.approx(np.pi / 6, rel=0.015)
    assert shape_mesh("torus").volume == pytest.approx(2 * np.pi**2 * 0.375 * 0.125**2, rel=0.04)
    assert shape_mesh("sponge").volume == pytest.approx((20 / 27) ** 2, rel=1e-12)


def test_torus_knot_is_as_thick_and_long_as_its_formula():
    t = np.linspace(0, 2 * np.pi, 20_001)
    length = np.linalg.norm(np.diff(shapes._knot(t), axis=0), axis=1).sum()
    scale = 1.0 / shapes._raw("torus_knot").extents.max()

    # Volume of a tube = cross-section x length of its centre line (Pappus), less for the 10 corners.
    decagon = 5 * np.sin(2 * np.pi / 10) * (shapes._KNOT_TUBE * scale) ** 2
    assert shape_mesh("torus_knot").volume == pytest.approx(decagon * length * scale, rel=0.02)


def test_surface_nets_give_an_ellipsoid():
    radii = np.array([0.9, 0.6, 0.4])
    mesh = surface(ellipsoid((0.1, 0, 0), radii), (-1, -1, -1), (1.2, 1, 1), 0.1)

    assert mesh.is_closed
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * radii.prod(), rel=0.03)  # chords cut off (0.1 / 0.4)^2 / 4
    on_it = (((mesh.vertices - [0.1, 0, 0]) / radii) ** 2).sum(axis=1)
    assert on_it == pytest.approx(1.0, abs=0.01)
    with pytest.raises(ValueError, match="fit"):
        surface(ellipsoid((0, 0, 0), radii), (-0.5, -1, -1), (1, 1, 1), 0.1)


def test_unknown_shape_lists_the_known_ones():
    with pytest.raises(ValueError, match="torus_knot"):
        shape_mesh("banana")


# Thousandths of the longest side: (visible surface outside of what collides, what collides outside of the visible).
STANDOFF = {
    "cube": (0, 0),
    "cylinder": (0, 3),  # round primitives around inscribed polyhedra
    "sphere": (0, 4),
    "cone": (0, 0),
    "torus": (4, 4),
    "gear": (0, 140),  # its hole is filled
    "torus_knot": (19, 19),
    "sponge": (0, 236),  # its holes are filled
    "spot": (0, 53),
    "teapot": (0, 66),  # its handle is filled
    "suzanne": (0, 38),
}


@pytest.mark.parametrize("name", SHAPES)
def test_what_collides_is_near_to_what_is_seen(name: str):
    out, beyond = standoff(name)
    # The nearest of 40,000 points on an area of up to 6 is about 0.012 away.
    assert out <= STANDOFF[name][0] / 1000 + 1e-3
    assert beyond <= STANDOFF[name][1] / 1000 + 0.013
    assert len(collision_parts(name)) <= 16


def test_parts_scale_about_the_origin():
    for name in ("torus", "gear", "spot"):
        points, _ = points_on(shape_mesh(name), 200)
        for part in collision_parts(name):
            assert part.scaled(2.5).distance(2.5 * points) == pytest.approx(2.5 * part.distance(points), abs=1e-12)


def test_capsule_lies_around_its_segment():
    start, end = np.array([0.1, -0.4, 0.3]), np.array([-0.2, 0.5, -0.6])
    part = capsule(start, end, 0.2)
    assert part.distance(np.stack([start, end, (start + end) / 2])) == pytest.approx(-0.2)
    across = np.cross(end - start, [0.0, 0.0, 1.0])
    assert part.distance(start + across / np.linalg.norm(across)) == pytest.approx(0.8)
    down = capsule(np.array([0.0, 0, 1]), np.array([0.0, 0, -1]), 0.1)
    assert down.distance(np.array([0.0, 0.0, -1.1])) == pytest.approx(0.0, abs=1e-12)
    expected = Rotation.from_quat(np.roll(part.quaternion, -1)).as_matrix()
    assert rotation_matrix(part.quaternion) == pytest.approx(expected)


def test_hull_is_closed_outward_and_holds_its_points():
    points = np.random.default_rng(0).normal(size=(300, 3))
    part = hull(points)
    assert part.mesh is not None and part.mesh.is_closed and part.mesh.volume > 0
    assert part.distance(points).max() < 1e-9
    assert part.distance(3 * points[np.argmax(np.linalg.norm(points, axis=1))]) > 0
    with pytest.raises(ValueError, match="no volume"):
        hull(points * [1, 1, 0])
    with pytest.raises(ValueError, match="no volume"):
        hull(points[:3])


def test_only_the_modelled_shapes_are_stand_ins():
    assert {"spot", "teapot", "suzanne"} <= set(SHAPES) and len(SHAPES) == 11


def test_box_and_cylinder_distances_are_exact():
    box, cylinder = CollisionPart("box", (1.0, 2.0, 3.0)), CollisionPart("cylinder", (1.0, 2.0))
    points = np.array([[2.0, 3.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 3.5]])
    assert box.distance(points) == pytest.approx([np.sqrt(2), -1.0, 0.5])
    assert cylinder.distance(points) == pytest.approx([np.sqrt(13) - 1, -1.0, 1.5])
