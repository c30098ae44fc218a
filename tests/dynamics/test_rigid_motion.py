import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.dynamics.solids import cube, even_cube, rotation_about
from vpd_lightning.dynamics.inertial.rigid_motion import (
    equidistant_centers,
    fit_twists,
    rigid_fit,
    rotate,
    rotation_from_spin,
)


def test_spin_is_twice_the_tangent_of_half_the_angle():
    axis, angle = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64), 0.7

    rotation = rotation_from_spin(2 * math.tan(angle / 2) * axis)

    assert torch.allclose(rotation, rotation_about([0.6, 0.0, 0.8], angle), atol=1e-12)


def test_twist_fit_recovers_a_rigid_motion_exactly():
    positions, _, _ = cube(200, seed=0)
    rotation, shift = rotation_about([1, 2, -1], 0.4), torch.tensor([0.05, -0.02, 0.1], dtype=torch.float64)
    after = positions @ rotation.T + shift
    weights = torch.full((1, 1, 200), 1 / 200, dtype=torch.float64)

    twists = fit_twists(after[None], (after - positions)[None], weights)

    # 1e-5: the ridge of 1e-6 on an inertia of about 0.02
    assert torch.allclose(rotation_from_spin(twists.spins)[0, 0], rotation, atol=1e-4)
    assert torch.allclose(twists.displacements[0, 0], (after - positions).mean(0), atol=1e-12)


def test_centre_of_a_cube_is_found_from_the_faces_that_are_seen():
    positions, _, normals = cube(500, seed=1)
    rotation, shift = rotation_about([1, 1, 0], 0.8), torch.tensor([0.3, -0.2, 0.6], dtype=torch.float64)
    weights = torch.full((1, 1, 500), 1 / 500, dtype=torch.float64)

    centers = equidistant_centers((positions @ rotation.T + shift)[None], (normals @ rotation.T)[None], weights)

    mean_error = positions.mean(0).norm()
    assert (centers[0, 0] - shift).norm() < 0.2 * mean_error


@pytest.mark.parametrize("faces", [[0, 2], [0, 2, 4], [1, 2, 5]])
def test_extents_find_the_centre_of_a_cube_of_which_a_corner_is_seen(faces):
    """Tangent planes alone leave it anywhere on the diagonal through the corner."""
    positions, normals = even_cube(10)
    some = torch.cat([torch.arange(100 * face, 100 * face + 100) for face in faces])
    rotation, shift = rotation_about([1, 1, 0], 0.8), torch.tensor([0.3, -0.2, 0.6], dtype=torch.float64)
    seen, directions = (positions[some] @ rotation.T + shift)[None], (normals[some] @ rotation.T)[None]
    strays = torch.tensor([[[9.0, 9.0, 9.0]] * 2], dtype=torch.float64)  # of another anchor, and far away
    seen, directions = torch.cat([seen, strays], dim=1), torch.cat([directions, torch.zeros_like(strays)], dim=1)
    weights = torch.zeros(1, 2, len(some) + 2, dtype=torch.float64)
    weights[0, 0, : len(some)], weights[0, 1, len(some) :] = 1 / len(some), 1 / 2

    by_planes = equidistant_centers(seen, directions, weights)[0, 0]
    centers = equidistant_centers(seen, directions, weights, extent_weight=0.1)[0]

    assert (by_planes - shift).norm() > 0.07
    assert (centers[0] - shift).norm() < 0.02
    assert torch.allclose(centers[1], strays[0, 0])


@pytest.mark.parametrize("extent_weight", [0.0, 0.1])
def test_one_seen_face_leaves_the_centre_with_the_particles(extent_weight):
    positions = torch.rand(100, 3, dtype=torch.float64)
    positions[:, 2] = 0
    normals = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(100, 3)
    weights = torch.full((1, 1, 100), 0.01, dtype=torch.float64)

    centers = equidistant_centers(positions[None], normals[None], weights, extent_weight)

    assert torch.allclose(centers[0, 0], positions.mean(0), atol=1e-6)


def test_a_fit_finds_the_rotation_of_weighted_points_exactly():
    source, _, _ = cube(60, seed=7)
    rotation, shift = rotation_about([2, -1, 1], 2.0), torch.tensor([0.4, 0.1, -0.3], dtype=torch.float64)
    weights = torch.rand(1, 3, 60, dtype=torch.float64)

    found, here, there = rigid_fit(source[None], (source @ rotation.T + shift)[None], weights)

    # 1e-7 is added to a covariance of about 0.01
    assert torch.allclose(found, rotation.expand(1, 3, 3, 3), atol=1e-4)
    assert torch.allclose(there[0], here[0] @ rotation.T + shift, atol=1e-12)


def test_a_fit_agrees_with_that_of_scipy_on_points_that_match_badly():
    generator = torch.Generator().manual_seed(1)
    source, goal = torch.randn(2, 25, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(25, generator=generator, dtype=torch.float64)

    found, here, there = rigid_fit(source[None], goal[None], weights[None, None])

    a, b = source - here[0, 0], goal - there[0, 0]
    expected, _ = Rotation.align_vectors(b.numpy(), a.numpy(), weights=weights.numpy())
    assert torch.allclose(found[0, 0], torch.from_numpy(expected.as_matrix()), atol=1e-5)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_fit_of_hardly_any_points_is_a_finite_rotation(count):
    source, _, _ = cube(5, seed=0)
    weights = (torch.arange(5) < count).double()[None, None]

    found, here, there = rigid_fit(source[None], source[None] + 0.1, weights)

    assert torch.allclose(found @ found.mT, torch.eye(3, dtype=torch.float64), atol=1e-9)
    assert torch.linalg.det(found[0, 0]).item() == pytest.approx(1.0)
    if count:
        assert torch.allclose(there - here, torch.full_like(here, 0.1))


def test_rotate_is_a_matrix_product():
    rotation = rotation_about([0, 1, 1], 1.0)
    vectors = torch.randn(7, 3, dtype=torch.float64)

    assert torch.allclose(rotate(rotation, vectors), vectors @ rotation.T)
