"""What no camera saw of a body is guessed: where it must lie, what it looks like, and that it moves with the body."""

from dataclasses import replace

import pytest
import torch

from tests.dynamics.solids import ball, even_cube, random_rotation
from tests.dynamics.test_inertial import dynamics, roll, scene
from vpd_lightning.dynamics.inertial.hidden_side import HiddenGuess
from vpd_lightning.dynamics.inertial.rigid_motion import rotation_from_spin
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles

HALF = 0.15
GUESSING = {
    "guess_hidden": True,
    "mirror_hidden": True,
    "first_velocity": None,
    "contact_reach": 0.5,
    "extent_weight": 0.1,
}


def seen_cube(turn: torch.Tensor, camera: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The faces of a turned cube about the origin that look at a distant camera, and which points those are."""
    positions, normals = even_cube(12, HALF)
    positions, normals = positions @ turn.T, normals @ turn.T
    return positions, normals, normals @ camera > 0.2


def distances(some: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    return (some[:, None] - others).norm(dim=-1)


def two_frames(positions: torch.Tensor, normals: torch.Tensor, height: float = 0.8) -> tuple[Particles, Particles]:
    frame = scene(positions, torch.full_like(positions, 0.5), normals, height=height)
    return frame, frame


def distance_to_cube(points: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
    """Distance of points to the surface of the turned cube, from inside or outside."""
    local = (points @ turn).abs()
    outside = (local - HALF).clamp(min=0).norm(dim=-1)
    return torch.where(outside > 0, outside, (HALF - local).amin(dim=-1))


@pytest.mark.parametrize("seed", range(4))
def test_the_hidden_faces_of_a_cube_are_covered_and_no_others(seed: int) -> None:
    turn, camera = random_rotation(seed), torch.tensor([0.6, -0.5, 0.62], dtype=torch.float64)
    positions, normals, seen = seen_cube(turn, camera)
    assert 2 * 144 <= int(seen.sum()) < 4 * 144

    state = roll(dynamics(**GUESSING), *two_frames(positions[seen], normals[seen]), 1)[0]

    body = state.positions[0, state.moving[0]].mean(0) - positions[seen].mean(0)  # where the cube is by now
    hidden = state.hidden_side.positions[0, state.hidden_side.mask[0]] - body
    spacing = 2 * HALF / 12
    assert distance_to_cube(hidden, turn).max() < spacing
    unseen = positions[~seen]
    assert distances(unseen, hidden).amin(dim=1).max() < 3 * spacing  # a seam along the outline may stay open
    assert distances(unseen, hidden).amin(dim=1).median() < spacing
    assert distances(hidden, positions[seen]).min() > 0.9 * spacing
    towards = (state.hidden_side.normals[0, state.hidden_side.mask[0]] @ camera).max()
    assert towards < 0.21  # what is guessed faces away from the camera, or was too oblique to be called seen


def test_a_dent_that_a_camera_saw_stays_open() -> None:
    """A cube with a pit in its upper face, of which the bottom was seen: nothing lies over it."""
    side = 24
    spacing = 2 * HALF / side
    positions, normals = even_cube(side, HALF)
    pit = (normals[:, 2] > 0.5) & (positions[:, :2].abs() < 4 * spacing).all(dim=1)
    depth = torch.tensor([0.0, 0.0, 2.2 * spacing], dtype=torch.float64)
    sunk = torch.where(pit[:, None], positions - depth, positions)
    model = dynamics(**GUESSING)

    state = roll(model, *two_frames(sunk, normals), 1)[0]
    gap = roll(model, *two_frames(positions[~pit], normals[~pit]), 1)[0]

    def on_top(state: Particles) -> torch.Tensor:
        heights = state.hidden_side.positions[0, state.hidden_side.mask[0], 2]
        return heights > state.positions[0, state.moving[0], 2].max() - spacing

    assert not on_top(state).any()
    assert on_top(gap).any()  # where nothing was seen, the face goes on


def test_half_a_ball_gets_its_other_half() -> None:
    positions, _, normals = ball(600, seed=1)
    seen = positions[:, 0] > 0

    state = roll(dynamics(**GUESSING), *two_frames(positions[seen], normals[seen]), 1)[0]

    body = state.positions[0, state.moving[0]].mean(0) - positions[seen].mean(0)
    hidden = state.hidden_side.positions[0, state.hidden_side.mask[0]] - body
    assert len(hidden) > 0.6 * int(seen.sum())  # what is beside the outline was seen
    assert (hidden.norm(dim=-1) - HALF).abs().max() < 0.03  # its extent makes half a ball look less deep
    assert hidden[:, 0].max() < 0.03


def test_nothing_is_guessed_where_all_was_seen_or_one_face_alone() -> None:
    positions, normals = even_cube(12, HALF)
    model = dynamics(**GUESSING)
    for shown in (slice(None), slice(0, 144)):
        state = roll(model, *two_frames(positions[shown], normals[shown]), 1)[0]
        assert not state.hidden_side.mask.any()


def test_nothing_is_guessed_below_the_floor() -> None:
    """A cube half sunk in the floor: its bottom's place is taken."""
    turn = torch.eye(3, dtype=torch.float64)
    positions, normals, _ = seen_cube(turn, torch.tensor([0.5, 0.5, 0.7], dtype=torch.float64))
    seen = (normals[:, 2] > 0.5) | ((normals[:, 0] > 0.5) & (positions[:, 2] > 0))

    state = roll(dynamics(**GUESSING), *two_frames(positions[seen], normals[seen], height=0.0), 1)[0]

    hidden = state.hidden_side.positions[0, state.hidden_side.mask[0]]
    assert (hidden[:, 2] > -0.02).all()


def test_it_moves_with_its_body() -> None:
    """Tossed freely, seen and hidden points together stay the rigid cube that was there."""
    camera = torch.tensor([0.6, -0.5, 0.62], dtype=torch.float64)
    turn, spin = random_rotation(3), torch.tensor([0.1, -0.15, 0.05], dtype=torch.float64)
    positions, normals, seen = seen_cube(turn, camera)
    step = rotation_from_spin(spin)
    before = positions @ step, normals @ step  # one step earlier
    previous, current = (two_frames(*(part[seen] for part in pair))[0] for pair in (before, (positions, normals)))
    settings = {name: value for name, value in GUESSING.items() if name != "first_velocity"}

    states = roll(dynamics(**settings), previous, current, 6)

    def cloud(state: Particles) -> torch.Tensor:
        return torch.cat([state.positions[0, state.moving[0]], state.hidden_side.positions[0]])

    pairs = [distances(cloud(state), cloud(state)) for state in states]
    assert (pairs[-1] - pairs[0]).abs().max() < 1e-9
    turned = states[-1].hidden_side.normals[0]
    assert (turned - states[0].hidden_side.normals[0]).norm(dim=-1).max() > 0.3
    assert torch.allclose(turned.norm(dim=-1), torch.ones(len(turned), dtype=turned.dtype))


def test_the_observed_frame_has_the_hidden_side_of_a_body_that_does_not_move() -> None:
    camera = torch.tensor([0.6, -0.5, 0.62], dtype=torch.float64)
    positions, normals, seen = seen_cube(random_rotation(2), camera)
    previous, current = two_frames(positions[seen], normals[seen])
    model = dynamics(**GUESSING)

    observed = model.completed(previous, current, RandomKeys.fixed(1))
    following = roll(model, previous, current, 1)[0]

    assert observed.hidden_side.mask.any()
    for name in ("positions", "normals", "features", "mask"):
        torch.testing.assert_close(getattr(observed.hidden_side, name), getattr(following.hidden_side, name))
    assert observed.positions is current.positions
    assert dynamics().completed(previous, current, RandomKeys.fixed(1)) is current


def test_features_lie_between_the_bodys_mean_and_what_lies_opposite() -> None:
    camera = torch.tensor([0.6, -0.5, 0.62], dtype=torch.float64)
    positions, normals, seen = seen_cube(random_rotation(1), camera)
    previous, current = two_frames(positions[seen], normals[seen])
    model = dynamics(**GUESSING)
    torch.nn.init.zeros_(model.moving_shading.network[-1].weight)
    with torch.no_grad():
        model.hidden_guess.logit_of_opposite.copy_(torch.tensor([-50.0, 50.0, 0.0, 1.0]))

    state = roll(model, previous, current, 1)[0]

    features, places = current.features[0, current.moving[0]], state.positions[0, state.moving[0]]
    mean = features.mean(0)
    share = torch.tensor([0.0, 1.0, 0.5, 1 / (1 + torch.e**-1.0)], dtype=torch.float64)
    hidden, memory = state.hidden_side, model.initialize(previous, current, RandomKeys.fixed(1)).hidden
    center = None
    for slot in hidden.mask[0].nonzero().flatten():
        index, weights = memory.index[0, slot], memory.weights[0, slot]
        opposite = sum(abs(float(weight)) * features[row] for weight, row in zip(weights, index, strict=True))
        assert torch.allclose(hidden.features[0, slot], mean + share * (opposite - mean), atol=1e-6)
        if weights.tolist() == [-1, 0, 0]:  # a mirror image: all lie opposite through one point
            middle = (hidden.positions[0, slot] + places[index[0]]) / 2
            center = middle if center is None else center
            assert torch.allclose(middle, center, atol=1e-9)
    assert center is not None
    hidden.features.sum().backward()
    gradient = model.hidden_guess.logit_of_opposite.grad
    assert torch.isfinite(gradient).all() and (gradient[2:] != 0).all()


def test_members_of_a_batch_and_padding_do_not_matter() -> None:
    camera = torch.tensor([0.6, -0.5, 0.62], dtype=torch.float64)
    model = dynamics(**GUESSING)
    frames = []
    for seed in range(2):
        positions, normals, seen = seen_cube(random_rotation(seed), camera)
        rows = seen.nonzero().flatten()[:280]
        frames.append(two_frames(positions[rows], normals[rows])[1])
    names = ("positions", "features", "colors", "moving", "normals")
    both = Particles(**{name: torch.cat([getattr(frame, name) for frame in frames]) for name in names})
    junk = torch.full_like(both.mask[:, :7], False)
    padded = both.mapped(lambda values: torch.cat([values, values[:, :7]], dim=1))
    padded = replace(padded, mask=torch.cat([both.mask, junk], dim=1))

    alone = [roll(model, frame, frame, 2)[1].hidden_side for frame in frames]
    for together in (roll(model, both, both, 2)[1].hidden_side, roll(model, padded, padded, 2)[1].hidden_side):
        for member, side in enumerate(alone):
            there = together.mask[member]
            assert torch.equal(together.positions[member, there], side.positions[0, side.mask[0]])
            assert torch.allclose(together.features[member, there], side.features[0, side.mask[0]])


def test_without_bodies_that_are_carried_there_is_none() -> None:
    for changes in ({"keep_shape": False}, {"carry_memory": False}, {"guess_hidden": False}):
        model = dynamics(**{**GUESSING, **changes})
        positions, _, normals = ball(100, seed=0)
        assert model.hidden_guess is None
        assert roll(model, *two_frames(positions, normals), 1)[0].hidden_side is None


def test_no_body_no_guess() -> None:
    assert HiddenGuess(feature_dim=4).logit_of_opposite.shape == (4,)
    positions, _, normals = ball(100, seed=0)
    still = replace(two_frames(positions, normals)[1], moving=torch.zeros(1, 150, dtype=torch.bool))
    state = roll(dynamics(**GUESSING), still, still, 1)[0]
    assert not state.hidden_side.mask.any()


CLOUDS = {
    "one place": torch.zeros(40, 3),
    "a line": torch.linspace(-1, 1, 40)[:, None] * torch.tensor([1.0, 0, 0]),
    "a plane": torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 1, 0]),
    "four places": torch.eye(4)[:, :3],
    "grains": 1e-6 * torch.randn(60, 3, generator=torch.Generator().manual_seed(1)),
    "far away": 1e4 + torch.randn(60, 3, generator=torch.Generator().manual_seed(2)),
}


@pytest.mark.parametrize("has_normals", [True, False])
@pytest.mark.parametrize("name", CLOUDS)
def test_degenerate_bodies_give_finite_guesses_and_gradients(name: str, has_normals: bool) -> None:
    positions = CLOUDS[name]
    normals = torch.nn.functional.normalize(torch.randn(len(positions), 3, generator=torch.Generator().manual_seed(3)))
    previous, current = two_frames(positions, normals * has_normals, height=0.0)
    previous, current = previous.to(torch.float32), current.to(torch.float32)
    model = dynamics(**GUESSING).float()

    side = roll(model, previous, current, 3)[-1].hidden_side

    assert all(torch.isfinite(part).all() for part in (side.positions, side.features, side.normals))
    distance = distances(side.positions[0, side.mask[0]], positions.to(side.positions)).flatten()
    assert distance.numel() == 0 or distance.max() < 3 * distances(positions, positions).max() + 1e-3
    (side.positions.sum() + side.features.sum()).backward()
    grads = [weight.grad for weight in model.parameters() if weight.grad is not None]
    assert all(torch.isfinite(grad).all() for grad in grads)
