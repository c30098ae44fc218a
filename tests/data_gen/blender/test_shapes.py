import math

import numpy as np
import pytest

from data_gen.blender import shapes

SHAPES = {
    "box": (shapes.box(np.array([0.3, 0.2, 0.1])), 8 * 0.3 * 0.2 * 0.1, 1e-12),
    # Tessellation cuts off 4/3 of what a chord does to a circle: a few parts in a thousand.
    "sphere": (shapes.ellipsoid(np.full(3, 0.5)), 4 / 3 * math.pi * 0.5**3, 3e-3),
    "ellipsoid": (shapes.ellipsoid(np.array([0.5, 0.2, 0.3])), 4 / 3 * math.pi * 0.5 * 0.2 * 0.3, 3e-3),
    "cylinder": (shapes.cylinder(0.4, 0.3), math.pi * 0.4**2 * 0.6, 1e-3),
    "capsule": (shapes.capsule(0.2, 0.3), math.pi * 0.2**2 * 0.6 + 4 / 3 * math.pi * 0.2**3, 3e-3),
}


@pytest.mark.parametrize("name", SHAPES)
def test_shape_encloses_its_volume_from_outside(name: str):
    """The divergence theorem: right only where the surface is closed and every face turns outwards."""
    triangles, volume, tolerance = SHAPES[name]
    a, b, c = triangles.vertices[triangles.faces].transpose(1, 0, 2)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(volume, rel=tolerance)
    assert np.cross(b - a, c - a).sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-9)


@pytest.mark.parametrize("name", SHAPES)
def test_normals_are_unit_and_lean_with_their_face(name: str):
    triangles = SHAPES[name][0]
    across = shapes.face_normals(triangles.vertices, triangles.faces)
    assert np.linalg.norm(triangles.normals, axis=1) == pytest.approx(1.0)
    assert (across * triangles.normals).sum(axis=1).min() > 0.97


@pytest.mark.parametrize("name", ["sphere", "ellipsoid", "capsule", "cylinder"])
def test_chart_turns_once_around_without_a_jump_inside_a_face(name: str):
    triangles = SHAPES[name][0]
    corners = triangles.vertices[triangles.faces]
    chart = triangles.chart.reshape(-1, 3, 2)
    is_side = np.abs(triangles.normals.reshape(-1, 3, 3)[:, :, 2]).max(axis=1) < 0.9
    assert np.ptp(chart[is_side, :, 0], axis=1).max() < 0.1
    off_axis = np.hypot(corners[..., 0], corners[..., 1]) > 1e-6
    turn = np.arctan2(corners[..., 1], corners[..., 0]) / (2 * np.pi)
    scaled = {"ellipsoid": np.array([0.5, 0.2])}.get(name, np.ones(2))
    turn = np.arctan2(corners[..., 1] / scaled[1], corners[..., 0] / scaled[0]) / (2 * np.pi)
    difference = (turn - chart[..., 0] + 0.5) % 1 - 0.5
    assert np.abs(difference[off_axis & is_side[:, None]]).max() < 1e-9
    assert chart[..., 1].min() >= -1e-9 and chart[..., 1].max() <= 1 + 1e-9


def test_plane_faces_up_and_its_texture_starts_at_the_far_left():
    plane = shapes.plane(2.0, 1.0)
    assert np.array_equal(plane.normals, np.tile([0.0, 0.0, 1.0], (6, 1)))
    corners = plane.vertices[plane.faces.ravel()]
    assert np.allclose(plane.chart, np.stack([(corners[:, 0] + 2) / 4, (1 - corners[:, 1]) / 2], axis=1))
