import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from vpd_lightning.dynamics.rigid_motion import (
    anchor_weights,
    equidistant_centers,
    farthest_points,
    fit_twists,
    match_locally_rigid,
    rotate,
    rotation_from_spin,
)

FACES = [(0, 1), (0, -1), (1, 1), (1, -1), (2, 1)]  # the bottom face is hidden
COLORS = torch.tensor([[0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8], [0.8, 0.8, 0.1], [0.1, 0.8, 0.8]])


def cube(count, seed, half=0.15, dtype=torch.float64):
    """Points, colours and normals on five faces of a cube about the origin."""
    generator = torch.Generator().manual_seed(seed)
    face = torch.randint(0, 5, (count,), generator=generator)
    positions = (torch.rand(count, 3, generator=generator, dtype=dtype) * 2 - 1) * half
    normals = torch.zeros(count, 3, dtype=dtype)
    for number, (axis, sign) in enumerate(FACES):
        positions[face == number, axis] = sign * half
        normals[face == number, axis] = sign
    return positions, COLORS[face].to(dtype), normals


def rotation_about(axis, angle):
    axis = torch.tensor(axis, dtype=torch.float64)
    vector = (axis / axis.norm() * angle).numpy()
    return torch.from_numpy(Rotation.from_rotvec(vector).as_matrix())


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


def test_one_seen_face_leaves_the_centre_with_the_particles():
    positions = torch.rand(100, 3, dtype=torch.float64)
    positions[:, 2] = 0
    normals = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(100, 3)
    weights = torch.full((1, 1, 100), 0.01, dtype=torch.float64)

    centers = equidistant_centers(positions[None], normals[None], weights)

    assert torch.allclose(centers[0, 0], positions.mean(0), atol=1e-6)


def random_toss(seed):
    previous, previous_colors, _ = cube(400, seed=10 + seed)
    points, colors, _ = cube(200, seed=30 + seed)
    start = torch.from_numpy(Rotation.random(rng=seed).as_matrix())
    generator = torch.Generator().manual_seed(seed)
    spin = (torch.rand(3, generator=generator, dtype=torch.float64) * 2 - 1) * 0.3  # up to 6 rad/s at 20 frames/s
    shift = (torch.rand(3, generator=generator, dtype=torch.float64) * 2 - 1) * 0.05
    turn = torch.from_numpy(Rotation.from_rotvec(spin.numpy()).as_matrix())
    before = points @ start.T
    return previous @ start.T, previous_colors, before @ turn.T + shift, colors, before


def test_matching_finds_the_motion_of_a_tossed_cube_within_a_centimetre():
    # Acceptance figure of the design: rms at most 1.0 cm where nothing moving at all costs several.
    errors, zeros = [], []
    for seed in range(12):
        previous, previous_colors, current, colors, before = random_toss(seed)
        brighter = colors * (0.9 + 0.02 * seed)  # shading differs between frames
        matched = match_locally_rigid(
            current[None],
            brighter[None],
            torch.ones(1, 200, dtype=torch.bool),
            previous[None],
            previous_colors[None],
            torch.ones(1, 400, dtype=torch.bool),
            num_anchors=4,
            radius=0.3,
            match_scales=[0.12, 0.07, 0.04, 0.025, 0.015],
            color_scale=0.05,
        )
        errors.append((matched[0] - before).square().sum(-1).mean())
        zeros.append((current - before).square().sum(-1).mean())

    assert torch.stack(errors).mean().sqrt() < 0.010
    assert torch.stack(zeros).mean().sqrt() > 0.04


def test_matching_a_still_body_finds_no_motion():
    positions, colors, _ = cube(200, seed=3)
    mask = torch.ones(1, 200, dtype=torch.bool)

    matched = match_locally_rigid(
        positions[None], colors[None], mask, positions[None], colors[None], mask,
        num_anchors=4, radius=0.3, match_scales=[0.05, 0.015], color_scale=0.05,
    )  # fmt: skip

    assert (matched[0] - positions).norm(dim=-1).max() < 2e-3


@pytest.mark.parametrize("count", [0, 1, 2])
def test_hardly_any_particles_give_finite_motions(count):
    positions, colors, _ = cube(5, seed=0)
    mask = (torch.arange(5) < count)[None]

    matched = match_locally_rigid(
        positions[None], colors[None], mask, positions[None] + 0.1, colors[None], mask,
        num_anchors=3, radius=0.3, match_scales=[0.05], color_scale=0.05,
    )  # fmt: skip

    assert torch.isfinite(matched).all()
    assert torch.equal(matched[0, count:], positions[count:])


def test_anchors_are_valid_particles_and_weights_ignore_padding():
    positions, _, _ = cube(30, seed=2)
    mask = (torch.arange(30) < 20)[None]

    anchors = farthest_points(positions[None], mask, 6)
    weights = anchor_weights(anchors, positions[None], mask, 0.2)

    assert all((anchor == positions[:20]).all(-1).any() for anchor in anchors[0])
    assert (weights[0, :, 20:] == 0).all() and (weights[0, :, :20] > 0).all()


def test_rotate_is_a_matrix_product():
    rotation = rotation_about([0, 1, 1], 1.0)
    vectors = torch.randn(7, 3, dtype=torch.float64)

    assert torch.allclose(rotate(rotation, vectors), vectors @ rotation.T)
