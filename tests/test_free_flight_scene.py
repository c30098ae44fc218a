"""The scene of balls in free flight (``vpd_lightning.testing.free_flight``): what it says is what it shows."""

import torch

from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.testing.free_flight import GRAVITY, RADIUS, FreeFlight


def test_what_the_cameras_see_of_a_ball_lies_on_it() -> None:
    flights = FreeFlight().flights(0, 0, 3, 2, 8)
    context = flights.batch.context
    assert bool(torch.isfinite(context.depth).all()) and bool((context.depth >= 0).all())
    for time in range(2):
        points = unproject(context.depth[:, time], context.cameras[:, time]).flatten(1, 3)
        distance = (points[:, :, None] - flights.centers[:, time, None]).norm(dim=-1)
        on_a_ball = (distance - RADIUS).abs() < 1e-3
        on_the_floor = points[..., 2].abs() < 1e-3
        seen = context.depth[:, time].flatten(1) > 0
        assert bool((on_a_ball.any(dim=-1) | on_the_floor)[seen].all())
        assert bool((on_a_ball.sum(dim=1) > 10).all())  # every ball is seen in every scene


def test_true_displacements_carry_balls_and_leave_the_floor() -> None:
    flights = FreeFlight(num_bodies=1).flights(1, 0, 4, 3, 8)
    context = flights.batch.context
    points = unproject(context.depth[:, 1], context.cameras[:, 1]).flatten(1, 3)
    body, moved = flights.body_of(points), flights.true_displacements(points)
    expected = flights.displacements[:, :, 0, None].expand_as(moved)
    torch.testing.assert_close(
        moved[(body == 0)[:, None].expand(-1, 3, -1)], expected[(body == 0)[:, None].expand(-1, 3, -1)]
    )
    assert not moved[(body < 0)[:, None].expand(-1, 3, -1)].any()
    # Second differences are gravity and nothing else.
    acceleration = flights.centers.diff(dim=1).diff(dim=1)
    torch.testing.assert_close(
        acceleration, torch.tensor([0.0, 0.0, -GRAVITY]).expand_as(acceleration), atol=1e-6, rtol=0
    )


def test_a_scene_depends_on_seed_and_step_alone() -> None:
    one, again, other = (FreeFlight().flights(0, step, 2, 1, 8).batch for step in (5, 5, 6))
    assert torch.equal(one.rgbs, again.rgbs) and torch.equal(one.context.depth, again.context.depth)
    assert not torch.equal(one.context.depth, other.context.depth)
