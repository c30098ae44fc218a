import numpy as np
import pytest

from data_gen.movi.collision_parts import hull
from data_gen.movi.inertia import solid_of
from data_gen.movi.mesh import Mesh
from data_gen.movi.shapes import shape_mesh


def test_box_has_its_closed_form_wherever_it_stands():
    sides, place = np.array([0.3, 0.7, 1.1]), np.array([5.0, -3.0, 2.0])
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3) * sides + place
    mesh = hull(corners).mesh
    assert mesh is not None
    volume, center, inertia = solid_of(mesh)

    square = sides**2
    expected = np.prod(sides) / 12 * np.array([square[1] + square[2], square[0] + square[2], square[0] + square[1]])
    assert volume == pytest.approx(np.prod(sides))
    np.testing.assert_allclose(center, place + sides / 2, rtol=1e-12)
    np.testing.assert_allclose(inertia, np.diag(expected), atol=1e-12)


def test_cone_has_its_centre_of_mass_at_a_quarter_of_its_height():
    """Kubric's cone, a pyramid over a regular polygon: its centre of mass is as a true cone's."""
    volume, center, inertia = solid_of(shape_mesh("cone"))
    np.testing.assert_allclose(center, [0, 0, -0.25], atol=1e-9)
    assert volume == pytest.approx(np.pi * 0.25 / 3, rel=0.005)  # 48 corners
    assert inertia[0, 0] == pytest.approx(3 / 80 * volume * (4 * 0.25 + 1), rel=0.005)


def test_turning_a_mesh_turns_its_inertia():
    mesh = shape_mesh("teapot")
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    _, center, inertia = solid_of(mesh)
    _, turned_center, turned_inertia = solid_of(Mesh(mesh.vertices @ turn.T, mesh.faces))
    np.testing.assert_allclose(turned_center, turn @ center, atol=1e-9)
    np.testing.assert_allclose(turned_inertia, turn @ inertia @ turn.T, atol=1e-9)
