"""Edits before a rollout, and MuJoCo's counterfactuals that they are held against."""

import numpy as np
import pytest
import torch

from data_gen.counterfactual import Change
from data_gen.deformable.counterfactual import Counterfactual
from data_gen.deformable.drop import draw_drop
from data_gen.deformable.settings import DeformableSettings
from data_gen.settings import load_settings
from docs.results.studies.edits import edited_state, surface_points
from vpd_lightning.types import Particles


def particles():
    generator = torch.Generator().manual_seed(0)
    return Particles(torch.rand(1, 6, 3, generator=generator), torch.rand(1, 6, 4, generator=generator))


def test_a_deleted_body_becomes_padding_and_a_moved_one_is_elsewhere():
    state, body = particles(), torch.tensor([True, False, True, False, False, False])

    deleted = edited_state(state, body, None)
    moved = edited_state(state, body, torch.tensor([4.0, 0.0, 0.0]))

    assert torch.equal(deleted.mask[0], ~body)
    assert torch.equal(deleted.positions, state.positions)
    assert torch.equal(moved.mask, state.mask)
    assert torch.equal(moved.positions[0, ~body], state.positions[0, ~body])
    assert torch.allclose(moved.positions[0, body] - state.positions[0, body], torch.tensor([4.0, 0.0, 0.0]))


def test_surface_points_lie_on_the_surface_and_go_with_it():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    moved = corners + [0.0, 0.0, 2.0]

    points = surface_points(np.stack([corners, moved]), np.array([[0, 1, 2, 3]]), 0).numpy()

    on_a_face = (np.abs(points[0]).min(axis=1) < 1e-12) | (np.abs(points[0].sum(axis=1) - 1) < 1e-12)
    assert on_a_face.all() and (points[0] >= 0).all()
    np.testing.assert_allclose(points[1] - points[0], np.tile([0.0, 0.0, 2.0], (len(points[0]), 1)), atol=1e-12)


@pytest.fixture(scope="module")
def truth():
    settings = load_settings(DeformableSettings, "deformable_collision", "small", {})
    return Counterfactual(settings, draw_drop(settings, 0, "validation", 0), frame=3)


def test_without_a_change_the_counterfactual_is_what_happens(truth):
    later = Counterfactual(truth.settings, truth.drop, frame=5)

    ran = truth.run({}, 2)

    for body, part in enumerate(truth.bodies.parts):
        # The solver is warm-started from the step before in one case and not in the other: its tolerance is left.
        assert np.abs(ran[body][1] - later.positions[part]).max() < 1e-5


def test_a_body_put_aside_falls_there_and_a_deleted_one_is_gone(truth):
    lower, upper = truth.run({1: Change(shift=(4.0, 0.0, 0.0))}, 2)
    alone = truth.run({1: Change(is_gone=True)}, 2)

    assert len(alone) == 1
    # Nothing touches yet, so the lower body does not know of the change.
    np.testing.assert_allclose(alone[0], lower, atol=1e-5)
    aside = upper[0] - truth.positions[truth.bodies.parts[1]]
    assert np.allclose(aside[:, 0].mean(), 4.0, atol=0.05) and aside[:, 2].mean() < 0


def test_a_body_that_is_given_a_velocity_goes_that_way(truth):
    settings = truth.settings
    velocity = np.array([0.05, 0.0, 0.02])  # metres a frame
    thrown = truth.run({1: Change(velocity=velocity.tolist())}, 1)[1][0]
    moved = (thrown - truth.positions[truth.bodies.parts[1]]).mean(axis=0)
    np.testing.assert_allclose(moved, velocity + [0, 0, -9.81 * settings.frame_time**2], atol=0.01)
