"""Rotation, velocity, energy and contact of bodies against SciPy and closed forms."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from vpd_lightning.metrics.body_dynamics import (
    GRAVITY,
    best_rotation,
    centroid_velocity,
    first_contact,
    orientation_error,
    specific_energy,
)

DT = 0.05


def body(num_particles: int = 40) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(0).normal(size=(num_particles, 3)))


def turned(start: torch.Tensor, rotations: Rotation) -> torch.Tensor:
    places = [rotation.apply(start.numpy()) + index for index, rotation in enumerate(rotations)]
    return torch.from_numpy(np.stack(places))


def test_best_rotation_is_the_true_one_and_scipys() -> None:
    start, rotations = body(), Rotation.random(5, rng=1)
    moved = turned(start, rotations)
    np.testing.assert_allclose(best_rotation(start, moved).numpy(), rotations.as_matrix(), atol=1e-12)

    noisy = moved + 0.3 * torch.randn(moved.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    centred = (start - start.mean(0)).numpy()
    expected = [Rotation.align_vectors(step - step.mean(0), centred)[0].as_matrix() for step in noisy.numpy()]
    np.testing.assert_allclose(best_rotation(start, noisy).numpy(), np.stack(expected), atol=1e-10)


@pytest.mark.parametrize("degrees", [0.0, 1e-5, 0.5, 90.0, 179.0, 180.0])
def test_orientation_error_is_the_angle_between_two_rotations(degrees: float) -> None:
    start, truth = body(), Rotation.random(rng=2)
    extra = Rotation.from_rotvec(np.deg2rad(degrees) * np.array([0.6, 0.0, 0.8]))
    pred, true = turned(start, Rotation.concatenate([extra * truth])), turned(start, Rotation.concatenate([truth]))

    assert float(orientation_error(pred, true, start)) == pytest.approx(degrees, abs=1e-6)


def test_velocity_and_energy_of_a_throw() -> None:
    time = DT * torch.arange(8, dtype=torch.float64)
    centroid = torch.stack([2 * time, 0 * time, 1 + 3 * time - GRAVITY / 2 * time**2], dim=-1)
    positions = body()[None] - body().mean(0) + centroid[:, None]

    middle = time[:-1] + DT / 2
    expected = torch.stack([2 + 0 * middle, 0 * middle, 3 - GRAVITY * middle], dim=-1)
    torch.testing.assert_close(centroid_velocity(positions, DT), expected)
    energy = specific_energy(positions, DT)
    assert float(energy[0]) == pytest.approx(2**2 / 2 + 3**2 / 2 + GRAVITY, abs=GRAVITY**2 * DT**2 / 4)
    assert float(energy.max() - energy.min()) < 1e-9  # a throw keeps it, exactly so at the middles of steps


def test_contact_is_where_a_fall_loses_half_its_speed() -> None:
    fall = [-0.5, -1.0, -1.5, -0.6, -0.1, 0.0]
    never, slow, rising = [-0.1 * step for step in range(6)], [-0.2, -0.2, 0.0, 0.0, 0.0, 0.0], [1.0, 0.5, 0, 0, 0, 0]
    velocities = torch.tensor([[fall, never], [slow, rising]], dtype=torch.float64)
    assert first_contact(velocities, 0.3).tolist() == [[3.0, torch.inf], [torch.inf, torch.inf]]

    braking = torch.linspace(-3.0, 0.0, 11, dtype=torch.float64)  # evenly, over many frames
    assert float(first_contact(torch.cat([braking.new_tensor([-1.0, -2.0]), braking]), 0.3)) == 2 + 5

    unknown = torch.tensor([-1.0, torch.nan, -1.0, 0.5], dtype=torch.float64)
    assert float(first_contact(unknown, 0.3)) == 3.0
    assert float(first_contact(unknown[:1], 0.3)) == torch.inf
