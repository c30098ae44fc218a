"""What rests is left alone, members of a batch by themselves; what is pushed is not."""

from dataclasses import replace

import pytest
import torch

from tests.dynamics.solids import even_cube
from tests.dynamics.test_inertial import dynamics
from vpd_lightning.actions import expanded
from vpd_lightning.dynamics.inertial import driven_bodies
from vpd_lightning.dynamics.inertial.resting import rows_of, with_rows
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Driven, Particles

HALF = 0.1
SETTINGS = {
    "has_driven": True,
    "supported_speed": 0.1,
    "edge_reach": 1.5,
    "first_velocity": None,
    "shadow_scales": None,
}


def cube_on_a_table() -> Particles:
    """A cube that stands on a table whose edge is 10 cm beside it; 2 cm of its foot were not seen. Batch of 1."""
    positions, normals = even_cube(6, HALF)
    seen = (normals[:, 2] > -0.5) & (positions[:, 2] > -HALF + 0.02)
    cube, facing = positions[seen] + torch.tensor([0, 0, HALF]).double(), normals[seen]
    axis = torch.arange(-20, 21, dtype=torch.float64) / 40
    x, y = (values.flatten() for values in torch.meshgrid(axis, axis, indexing="ij"))
    open_ = ((x.abs() > HALF) | (y.abs() > HALF)) & (x < 0.2)
    table = torch.stack([x, y, torch.zeros_like(x)], dim=-1)[open_]
    places = torch.cat([cube, table])
    up = torch.tensor([0, 0, 1.0]).double().expand_as(table)
    colors = torch.full_like(places, 0.5)
    moving = torch.arange(len(places)) < len(cube)
    features = torch.rand(len(places), 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Particles(
        places[None], features[None], colors=colors[None], moving=moving[None], normals=torch.cat([facing, up])[None]
    )


def plate(x: float, step: float, count: int = 1) -> Driven:
    """A square that faces +x at ``x`` and goes by ``step``, and then by as much again."""
    axis = torch.linspace(-0.08, 0.08, 7, dtype=torch.float64)
    y, z = (values.flatten() for values in torch.meshgrid(axis, axis, indexing="ij"))
    points = torch.stack([torch.full_like(y, x), y, z + HALF], dim=-1)[None].expand(count, -1, -1)
    normals = torch.tensor([1.0, 0, 0]).double().expand_as(points)
    groups = torch.zeros(points.shape[:2], dtype=torch.int64)
    shift = torch.tensor([step, 0, 0]).double()
    return Driven(points, normals, groups, next_positions=points + shift, next_normals=normals)


def model(**changes):
    torch.manual_seed(0)
    return dynamics(**{**SETTINGS, **changes}).eval()


def rolled(made, driven: Driven, num_steps: int, with_grad: bool = False) -> list[Particles]:
    scene = cube_on_a_table()
    scene = Particles(
        *(values.expand(len(driven.mask), *values.shape[1:]) for values in (scene.positions, scene.features)),
        colors=scene.colors.expand(len(driven.mask), -1, -1),
        moving=scene.moving.expand(len(driven.mask), -1),
        normals=scene.normals.expand(len(driven.mask), -1, -1),
        driven=driven,
    )
    keys = RandomKeys.fixed(len(driven.mask))
    previous, current, states = scene, scene, []
    with torch.set_grad_enabled(with_grad):
        memory = made.initialize(previous, current, keys)
        for step in range(num_steps):
            following, memory = made(previous, current, memory, keys, step)
            shift = driven.next_positions - driven.positions
            now = replace(current.driven, positions=current.driven.next_positions)
            following = replace(following, driven=replace(now, next_positions=now.positions + shift))
            previous, current = current, following
            states.append(following)
    return states


def test_a_resting_scene_stays_as_it_is_bit_for_bit_and_a_pushed_one_moves() -> None:
    made = model(skip_resting=True)
    still = rolled(made, plate(-0.5, 0.0), 5)
    assert all(torch.equal(state.positions, cube_on_a_table().positions) for state in still)
    pushed = rolled(made, plate(-0.11, 0.02), 5)[-1]
    moved = (pushed.positions - cube_on_a_table().positions)[0, cube_on_a_table().moving[0]].mean(dim=0)
    assert moved[0].item() == pytest.approx(0.09, abs=0.01) and moved[1:].abs().max() < 0.01


def heavy(**changes):
    """A model in which everything is pulled down; a cube seen in part would tip."""
    made = model(**changes)
    with torch.no_grad():
        made.forces.acceleration[2] = -0.3
    return made


def test_what_was_seen_to_stand_does_until_it_is_pushed() -> None:
    scene = cube_on_a_table()
    still = rolled(heavy(), plate(-0.5, 0.0), 6)
    assert max((state.positions - scene.positions).abs().max() for state in still) < 1e-12
    tipped = rolled(heavy(supported_speed=0.0), plate(-0.5, 0.0), 6)[-1]
    assert (tipped.positions - scene.positions).abs().max() > 0.005
    pushed = rolled(heavy(), plate(-0.11, 0.03), 12)[-1]
    down = (pushed.positions - scene.positions)[0, scene.moving[0], 2].mean()
    assert down < -0.05, "beyond the table's edge it falls"


def test_what_is_pushed_goes_as_it_goes_without_skipping() -> None:
    driven = plate(-0.11, 0.02)
    skipped, whole = (rolled(model(skip_resting=skip), driven, 5)[-1].positions for skip in (True, False))
    assert (skipped - whole).abs().max() < 1e-3


def test_members_rest_by_themselves() -> None:
    made = model(skip_resting=True)
    away, near = plate(-0.5, 0.0), plate(-0.11, 0.02)
    names = ("positions", "normals", "groups", "mask", "next_positions", "next_normals")
    both = Driven(**{name: torch.cat([getattr(away, name), getattr(near, name)]) for name in names})
    together = rolled(made, both, 4)[-1]
    for number, driven in enumerate((away, near)):
        alone = rolled(made, driven, 4)[-1]
        assert torch.allclose(together.positions[number], alone.positions[0], atol=1e-12)
        assert torch.allclose(together.features[number], alone.features[0], atol=1e-12)


def test_hidden_sides_are_drawn_of_those_that_move_and_of_those_that_rest() -> None:
    made = model(skip_resting=True, guess_hidden=True, mirror_hidden=True)
    names = ("positions", "normals", "groups", "mask", "next_positions", "next_normals")
    one, other = plate(-0.5, 0.0), plate(-0.11, 0.02)
    both = Driven(**{name: torch.cat([getattr(one, name), getattr(other, name)]) for name in names})
    first, *_, last = rolled(made, both, 4)
    assert first.hidden_side is not None and last.hidden_side is not None
    went = (last.hidden_side.positions - first.hidden_side.positions).norm(dim=-1)
    assert bool(last.hidden_side.mask.any(dim=1).all()), "each cube has a hidden side"
    assert went[0].max() < 1e-3 and went[1][last.hidden_side.mask[1]].min() > 0.03


def joined(*motions: Driven) -> Driven:
    names = ("positions", "normals", "groups", "mask", "next_positions", "next_normals")
    return Driven(**{name: torch.cat([getattr(one, name) for one in motions]) for name in names})


def test_candidates_from_one_moment_are_advanced_once_until_one_touches_a_body(monkeypatch) -> None:
    made = heavy(skip_resting=True, supported_speed=0.0)  # the cube tips: it moves in all candidates
    motions = [plate(-0.6, 0.0), plate(-0.11, 0.02), plate(-0.7, 0.0), plate(-0.2, 0.05)]
    sizes, step = [], made._step

    def counted(current, memory):
        sizes.append(len(current.mask))
        return step(current, memory)

    alone = [rolled(made, motion, 5)[-1] for motion in motions]
    monkeypatch.setattr(made, "_step", counted)
    driven, scene, keys = joined(*motions), cube_on_a_table(), RandomKeys.fixed(4)
    with torch.no_grad():
        first = replace(scene, driven=motions[0])
        memory = expanded(made.initialize(first, first, RandomKeys.fixed(1)), 4)
        previous = current = replace(expanded(scene, 4), driven=driven)
        for number in range(5):
            following, memory = made(previous, current, memory, keys, number)
            shift = driven.next_positions - driven.positions
            now = replace(current.driven, positions=current.driven.next_positions)
            following = replace(following, driven=replace(now, next_positions=now.positions + shift))
            previous, current = current, following

    assert sizes[:2] == [2, 3], "one for all that touch nothing, one for each of the others"
    assert sizes[-1] == 2, "where it is not pushed, the cube has come to rest"
    for number, one in enumerate(alone):
        assert torch.allclose(current.positions[number], one.positions[0], rtol=0, atol=1e-12)
        assert torch.allclose(current.features[number], one.features[0], rtol=0, atol=1e-12)
        assert torch.equal(current.driven.positions[number], motions[number].positions[0] + 5 * shift[number])
    assert not torch.equal(current.positions[0], current.positions[1])

    changed = current.positions.clone()
    changed[2] += 0.01  # by hand: no longer what its past says
    with torch.no_grad():
        following, _ = made(previous, replace(current, positions=changed), memory, keys, 5)
    assert not torch.equal(following.positions[2], following.positions[0])


def test_pasts_that_part_are_not_those_of_members_that_rest() -> None:
    made, motions = model(skip_resting=True), [plate(-0.6, 0.0), plate(-0.11, 0.02), plate(-0.11, 0.03)]
    first, keys = replace(cube_on_a_table(), driven=motions[0]), RandomKeys.fixed(3)
    with torch.no_grad():
        memory = expanded(made.initialize(first, first, RandomKeys.fixed(1)), 3)
        memory = replace(memory, past=torch.tensor([1, 0, 0]))  # the first one rests
        current = replace(expanded(cube_on_a_table(), 3), driven=joined(*motions))
        _, memory = made(current, current, memory, keys, 0)
    assert memory.past[0] == 1 and len(memory.past.unique()) == 3


def test_with_gradients_nothing_is_skipped() -> None:
    made = model(skip_resting=True)
    calls = []
    step = made._step
    made._step = lambda *given: calls.append(None) or step(*given)
    rolled(made, plate(-0.5, 0.0), 2)
    assert not calls
    rolled(made, plate(-0.5, 0.0), 2, with_grad=True)
    assert len(calls) == 2


def test_not_to_search_members_that_are_far_from_the_robot_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    near, far = plate(-0.13, 0.02), plate(-0.6, 0.02)
    both = Driven(
        *(torch.cat([getattr(near, name), getattr(far, name)]) for name in ("positions", "normals", "groups"))
    )
    both = replace(both, next_positions=torch.cat([near.next_positions, far.next_positions]), next_normals=both.normals)
    searched = []
    may_meet = driven_bodies._may_meet
    monkeypatch.setattr(driven_bodies, "_may_meet", lambda *given: searched.append(may_meet(*given)) or searched[-1])
    skipping = rolled(model(), both, 4)
    assert searched and all(rows.tolist() == [True, False] for rows in searched)
    monkeypatch.setattr(driven_bodies, "_may_meet", lambda bodies, *_: torch.ones(len(bodies.mask), dtype=torch.bool))
    whole = rolled(model(), both, 4)
    assert all(torch.equal(one.positions, other.positions) for one, other in zip(skipping, whole, strict=True))
    assert not torch.equal(whole[-1].positions[0], whole[-1].positions[1])  # the near one pushed


def test_rows_are_taken_and_put_back() -> None:
    driven = plate(0.0, 0.1, count=3)
    rows = torch.tensor([2, 0])
    some = rows_of(driven, rows, 3)
    assert len(some.positions) == 2 and torch.equal(some.groups, driven.groups[rows])
    changed = replace(some, positions=some.positions + 1.0)
    back = with_rows(driven, rows, some, changed, 3)
    assert back.normals is driven.normals  # it was not changed
    assert torch.equal(back.positions[1], driven.positions[1]) and torch.equal(back.positions[rows], changed.positions)
    assert back.features is None
