"""Bodies among particles: the middle of the whole of one that rolls, and bodies that were clustered as one. Metres."""

from dataclasses import replace

import torch

from vpd_lightning.dynamics.inertial.rigid_motion import rotation_from_spin
from vpd_lightning.planning.bodies import Body, find_bodies
from vpd_lightning.types import HiddenSide, Particles


def ball(middle: tuple[float, float, float], *, upper: bool) -> torch.Tensor:
    """Return points of half of a ball of 5 cm."""
    draw = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(200, 3, generator=draw, dtype=torch.float64), dim=-1)
    points[:, 2] = points[:, 2].abs() * (1 if upper else -1)
    return 0.05 * points + torch.tensor(middle)


def scene(*parts: torch.Tensor, hidden: torch.Tensor | None = None) -> Particles:
    positions = torch.cat(parts)[None]
    side = None
    if hidden is not None:
        side = HiddenSide(
            hidden[None],
            torch.zeros(1, len(hidden), 1).double(),
            torch.zeros_like(hidden)[None],
            torch.ones(1, len(hidden), dtype=torch.bool),
        )
    moving = torch.ones(positions.shape[:2], dtype=torch.bool)
    return Particles(positions, torch.zeros(*positions.shape[:2], 1).double(), moving=moving, hidden_side=side)


def test_the_middle_of_a_ball_that_rolls_is_not_that_of_its_seen_side() -> None:
    middle = torch.tensor([0.1, 0.0, 0.05], dtype=torch.float64)
    seen = ball((0.1, 0.0, 0.05), upper=True)
    now = scene(seen, hidden=ball((0.1, 0.0, 0.05), upper=False))
    body = Body.of(now, torch.ones(200, dtype=torch.bool))
    assert (body.middle - middle).norm() < 0.003 and abs(body.radius - 0.05) < 0.003
    turn = rotation_from_spin(torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64))  # a quarter
    rolled = replace(now, positions=((seen - middle) @ turn.T + middle + torch.tensor([0.08, 0, 0]))[None])
    reached = body.middles([now, rolled])
    assert torch.allclose(reached[0, 0], body.middle, atol=1e-9)
    assert (reached[0, 1] - middle - torch.tensor([0.08, 0, 0])).norm() < 0.003
    assert (rolled.positions[0].mean(dim=0) - reached[0, 1]).norm() > 0.02, "the seen side went around it"


def test_a_middle_is_carried_for_every_candidate() -> None:
    seen = ball((0.0, 0.0, 0.05), upper=True)
    now = scene(seen)
    body = Body.of(now, torch.arange(200) < 100)
    shifts = torch.tensor([[0.1, 0, 0], [0, 0.2, 0]], dtype=torch.float64)
    later = Particles(seen + shifts[:, None], torch.zeros(2, 200, 1).double())
    assert torch.allclose(body.middles([later])[:, 0], body.middle + shifts, atol=1e-9)
    one = Body(torch.arange(200) == 3, seen[3:4], seen[3] + 0.01)
    assert torch.allclose(one.middles([later])[:, 0], seen[3] + 0.01 + shifts)


def test_bodies_that_were_clustered_as_one_are_told_apart_by_where_they_are_expected() -> None:
    near = ball((0.0, 0.0, 0.05), upper=True), ball((0.09, 0.0, 0.05), upper=True)
    far = ball((0.5, 0.0, 0.05), upper=True)
    now = scene(*near, far)
    expected = torch.tensor([[0.09, 0.01, 0.05], [0.0, 0.0, 0.04], [0.5, 0.0, 0.05]], dtype=torch.float64)
    second, first, other = find_bodies(now, expected)
    owner = torch.arange(3).repeat_interleave(200)
    assert (second.chosen == (owner == 1)).double().mean() > 0.95
    assert (first.chosen == (owner == 0)).double().mean() > 0.95
    assert torch.equal(other.chosen, owner == 2)


def test_a_body_that_is_not_where_it_was_expected_is_the_cluster_that_no_other_is() -> None:
    now = scene(ball((0.0, 0.0, 0.05), upper=True), ball((0.3, 0.0, 0.05), upper=True))
    first, moved = find_bodies(now, torch.tensor([[0.0, 0.0, 0.05], [0.3, 0.15, 0.05]], dtype=torch.float64))
    assert int(first.chosen.sum()) == 200 and torch.equal(moved.chosen, torch.arange(400) >= 200)


def test_a_body_that_is_not_seen_is_where_it_was_expected() -> None:
    now = scene(ball((0.0, 0.0, 0.05), upper=True))
    fallen = torch.tensor([0.2, 0.0, -0.25], dtype=torch.float64)
    seen, lost = find_bodies(now, torch.stack([torch.tensor([0.0, 0.0, 0.05], dtype=torch.float64), fallen]))
    assert int(seen.chosen.sum()) == 200 and int(lost.chosen.sum()) == 1
    assert torch.equal(lost.middles([now])[0, 0], fallen)
    beside = torch.tensor([0.07, 0.0, -0.04], dtype=torch.float64)  # of its neighbour no particle is nearer to it
    seen, lost = find_bodies(now, torch.stack([torch.tensor([0.0, 0.0, 0.05], dtype=torch.float64), beside]))
    assert int(seen.chosen.sum()) == 200 and torch.equal(lost.middle, beside)
