"""Nearest points of meshes, against closed forms and against an optimiser."""

import numpy as np
import pytest
from scipy.optimize import minimize

from vpd_lightning.metrics.surface_distance import nearest_on_surface, surface_of

CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
TETRAHEDRA = np.array([[0, 1, 3, 5], [0, 2, 3, 6], [0, 4, 5, 6], [3, 5, 6, 7], [0, 3, 5, 6]], np.int32)  # of the cube


def test_the_surface_of_a_cut_cube_is_its_six_faces() -> None:
    triangles = surface_of(TETRAHEDRA)
    corners = CUBE[triangles]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert len(triangles) == 12 and areas.sum() == pytest.approx(6.0)
    assert all((face == face[0]).all(axis=0).any() for face in corners), "each lies in a face of the cube"


def test_distance_to_a_cube_inside_and_outside() -> None:
    points = np.random.default_rng(0).uniform(-0.5, 1.5, (400, 3))
    near = nearest_on_surface(points, CUBE[surface_of(TETRAHEDRA)])
    gap = np.maximum(np.maximum(-points, points - 1), 0)
    inner = np.minimum(points, 1 - points).min(axis=1)
    expected = np.where(inner > 0, inner, np.linalg.norm(gap, axis=1))
    np.testing.assert_allclose(near.distance, expected, atol=1e-12)


def test_weights_name_the_nearest_point_of_a_slanted_triangle() -> None:
    random = np.random.default_rng(1)
    for _ in range(20):
        corners, point = random.normal(size=(3, 3)), random.normal(size=3) * 2
        near = nearest_on_surface(point[None], corners[None])
        assert near.weights.min() >= -1e-12 and near.weights.sum() == pytest.approx(1)
        assert near.distance[0] == pytest.approx(np.linalg.norm(near.weights[0] @ corners - point))

        def distance(uv: np.ndarray, corners: np.ndarray = corners, point: np.ndarray = point) -> float:
            weights = np.array([1 - uv.sum(), *uv])
            return float(np.linalg.norm(weights @ corners - point))

        limits = {"type": "ineq", "fun": lambda uv: 1 - uv.sum()}
        found = minimize(distance, [0.3, 0.3], bounds=[(0, 1)] * 2, constraints=[limits], tol=1e-10)
        assert near.distance[0] == pytest.approx(found.fun, abs=1e-5)
