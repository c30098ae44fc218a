"""Rigid motion metrics against SciPy's rotations and closed forms."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from vpd_lightning.geometry.rotations import rotation_matrix
from vpd_lightning.metrics.rigid_motion import (
    centroid_error,
    inside_box,
    move_with_body,
    particle_error,
    rigidity_error,
    rms_radius,
)


def pose(position: list[float], rotation: Rotation) -> torch.Tensor:
    return torch.tensor([*position, *np.roll(rotation.as_quat(), 1)], dtype=torch.float64)


def test_rotation_matrix_equals_scipy() -> None:
    rotations = Rotation.random(5, rng=0)
    quaternions = torch.tensor(np.roll(rotations.as_quat(), 1, axis=1)) * 1.7
    torch.testing.assert_close(rotation_matrix(quaternions), torch.tensor(rotations.as_matrix()))


def test_points_fixed_to_a_body_follow_its_pose() -> None:
    first, second = Rotation.random(2, rng=1)
    local = np.random.default_rng(0).normal(size=(7, 3))
    start = pose([0.1, 0.2, 0.3], first)
    later = torch.stack([start, pose([-1.0, 0.5, 0.7], second)])
    moved = move_with_body(torch.tensor(first.apply(local) + start[:3].numpy()), start, later)
    np.testing.assert_allclose(moved[0].numpy(), first.apply(local) + [0.1, 0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(moved[1].numpy(), second.apply(local) + [-1.0, 0.5, 0.7], atol=1e-12)


def test_the_box_turns_with_the_body_and_has_a_margin() -> None:
    tilted = pose([1.0, 0.0, 0.0], Rotation.from_euler("z", 90, degrees=True))
    half_size = torch.tensor([0.5, 0.1, 0.1], dtype=torch.float64)
    points = torch.tensor([[1.0, 0.51, 0.0], [1.0, 0.53, 0.0], [1.5, 0.0, 0.0]], dtype=torch.float64)
    assert inside_box(points, tilted, half_size, margin=0.02).tolist() == [True, False, False]


def test_centroid_and_particle_errors_of_a_known_offset() -> None:
    true = torch.randn(3, 20, 3, generator=torch.Generator().manual_seed(0))
    pred = true + torch.tensor([0.03, 0.0, 0.04])
    torch.testing.assert_close(centroid_error(pred, true), torch.full((3,), 0.05), atol=1e-6, rtol=0)
    torch.testing.assert_close(particle_error(pred, true), torch.full((3,), 0.05), atol=1e-6, rtol=0)


def test_a_rigid_motion_keeps_the_radius_and_has_no_rigidity_error() -> None:
    start = torch.randn(30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    turned = start @ rotation_matrix(torch.tensor([0.3, -0.5, 0.7, 0.2], dtype=torch.float64)).T + 2.0
    assert rms_radius(turned).item() == pytest.approx(rms_radius(start).item(), abs=1e-12)
    assert rigidity_error(torch.stack([start, turned]), start).max() < 1e-12


def test_a_mirror_image_is_no_rigid_motion() -> None:
    start = torch.randn(30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert rigidity_error((start * torch.tensor([1.0, 1.0, -1.0]))[None], start).item() > 0.1


def test_swelling_shows_in_radius_and_rigidity() -> None:
    start = torch.randn(30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert (rms_radius(1.5 * start) / rms_radius(start)).item() == pytest.approx(1.5)
    assert rigidity_error(1.5 * start[None], start).item() == pytest.approx(0.5 * rms_radius(start).item())
