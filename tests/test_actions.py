"""Actions: pixels of what is driven leave the observation, its points are drawn, and its motion is an input."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from tests.encoder.test_unet import encoder as plain_encoder
from tests.test_simulator import renderer
from vpd_lightning.actions import MAX_STEP, expanded
from vpd_lightning.config import build, compose
from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.persistence import PersistenceDynamics
from vpd_lightning.errors import ActionError, ConfigError
from vpd_lightning.geometry.driven_pixels import nearest_pixels, seen_through_share, shows_driven
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.simulator import Scene, Simulator
from vpd_lightning.testing import WORKSPACE_MAX, WORKSPACE_MIN, ball_frames, ball_particles, ring_cameras
from vpd_lightning.types import Driven, Particles, RGBDFrames

CENTER, RADIUS, VELOCITY = (0.05, -0.05, 0.3), 0.15, (0.03, 0.02, -0.02)  # of the ball of the first member
NUM_STEPS = 4


def ball_points(count: int = 120) -> tuple[torch.Tensor, torch.Tensor]:
    """Evenly spread points and normals of the ball."""
    index = torch.arange(count, dtype=torch.float64)
    height, angle = 1 - 2 * (index + 0.5) / count, index * torch.pi * (3 - 5**0.5)
    ring = (1 - height.square()).sqrt()
    normals = torch.stack([ring * angle.cos(), ring * angle.sin(), height], dim=-1)
    return RADIUS * normals + torch.tensor(CENTER, dtype=torch.float64), normals


def motion(num_steps: int = NUM_STEPS + 2, velocity: tuple[float, float, float] = VELOCITY) -> Driven:
    """The ball as something driven, from the first context frame on (axis ``step``)."""
    points, normals = ball_points()
    steps = torch.arange(num_steps, dtype=torch.float64)[:, None, None] * torch.tensor(velocity, dtype=torch.float64)
    made = Driven.from_arrays(points + steps, normals.expand(num_steps, -1, -1))
    return made.to(torch.float64)


def seen(time: int = 0) -> RGBDFrames:
    return replace(ball_frames(1, time), driven=motion()[time : time + 1])


def is_ball(frames: RGBDFrames) -> torch.Tensor:
    empty = ball_frames(1, has_ball=False)
    return (frames.depth - empty.depth).abs() > 1e-6


def test_a_motion_is_made_of_arrays() -> None:
    made = Driven.from_arrays([[[0, 0, 0], [1, 0, 0]]], [[[0, 0, 1], [0, 0, 1]]], [0, 1])
    assert made.positions.shape == (1, 2, 3) and made.groups.tolist() == [[0, 1]] and bool(made.mask.all())
    with pytest.raises(ValueError, match=r"must both be \(step, point, 3\)"):
        Driven.from_arrays([[0, 0, 0]], [[0, 0, 1]])
    with pytest.raises(ValueError, match="groups must name the part of each of 2 points"):
        Driven.from_arrays([[[0, 0, 0], [1, 0, 0]]], [[[0, 0, 1], [0, 0, 1]]], [0, 1, 2])


def test_frames_take_what_is_driven_along_without_its_having_views() -> None:
    frames = ball_frames(2)
    two = replace(frames, driven=motion(2))  # batch of 2
    assert two[1:].driven.positions.shape[0] == 1 and two[:, [0]].driven.positions.shape[0] == 2
    assert two[:, [0]].depth.shape[1] == 1 and two[0].driven.positions.dim() == 2


def test_the_pixels_of_what_is_driven_are_found() -> None:
    frames = seen()
    found, ball = shows_driven(frames), is_ball(frames)
    assert bool((found | ~ball).all()), "a pixel of the ball was taken for something else"
    grown = torch.nn.functional.max_pool2d(ball.double(), 5, stride=1, padding=2) > 0
    assert bool((grown | ~found).all()), "pixels far from the ball were taken for it"
    assert not shows_driven(replace(frames, driven=None)).any()
    # Where the sensor lost the ball, its points say where it is.
    blind = replace(frames, depth=torch.where(ball, 0.0, frames.depth))
    assert (shows_driven(blind) & ball).sum() > 0.9 * ball.sum()


def test_what_stands_in_front_of_it_is_not_taken_for_it() -> None:
    frames = seen()
    near = torch.where(is_ball(frames), frames.depth - 0.3, frames.depth)
    assert not (shows_driven(replace(frames, depth=near)) & is_ball(frames)).any()


def test_points_take_the_pixel_that_shows_them() -> None:
    points = torch.zeros(1, 4, 3, dtype=torch.float64)
    points[0, :, 0] = torch.arange(4)
    shown = torch.tensor([[True, False, True, False]])
    driven = Driven.from_arrays([[[0.1, 0, 0], [1.2, 0, 0], [3.0, 0, 0]]], [[[0, 0, 1]] * 3]).to(torch.float64)
    index, is_seen = nearest_pixels(driven, points, shown)
    assert index.tolist() == [[0, 2, 2]] and bool(is_seen.all())
    assert not nearest_pixels(driven, points, torch.zeros_like(shown))[1].any()


def test_a_camera_that_sees_through_the_points_contradicts_them() -> None:
    frames = seen()
    assert frames.driven is not None
    assert seen_through_share(frames).item() < 0.1  # at its outline a pixel of sixteen sees past it
    lifted = replace(frames.driven, positions=frames.driven.positions + torch.tensor([0.0, 0.0, 0.35]).double())
    assert seen_through_share(replace(frames, driven=lifted)).item() > 0.5
    below = replace(frames.driven, positions=frames.driven.positions - torch.tensor([0.0, 0.0, 0.5]).double())
    assert seen_through_share(replace(frames, driven=below)).item() == 0, "what is hidden cannot be contradicted"


def encoder(**changes: Any) -> torch.nn.Module:
    return plain_encoder(workspace_min=list(WORKSPACE_MIN), workspace_max=list(WORKSPACE_MAX), **changes).double()


def encoded(model: torch.nn.Module, frames: RGBDFrames, purpose: str = "current") -> Particles:
    return model(frames, RandomKeys(0, 0, [0]), purpose).particles


def test_what_is_driven_becomes_no_particle_and_gets_the_features_of_its_pixels() -> None:
    torch.manual_seed(0)
    model = encoder(num_particles=400, has_driven=True, color_features=True)
    particles = encoded(model, seen())
    distances = (particles.positions - torch.tensor(CENTER).double()).norm(dim=-1)[particles.mask]
    assert distances.min() > RADIUS + 0.005
    driven = particles.driven
    assert driven is not None and driven.features is not None
    above = driven.normals[0, :, 2] > 0.3  # cameras look from above; the ball's colour is its place plus a half
    expected = (0.5 + driven.positions[0, above]).clamp(0, 1)
    assert (driven.features[0, above, :3] - expected).abs().median() < 0.05
    assert encoded(model, seen(), "previous").driven is not None


def test_without_actions_nothing_is_different() -> None:
    torch.manual_seed(0)
    model = encoder(num_particles=60)
    plain, given = (encoded(model, frames) for frames in (ball_frames(1), seen()))
    assert torch.equal(plain.positions, given.positions) and torch.equal(plain.features, given.features)
    assert given.driven is None
    torch.manual_seed(0)
    with_actions = encoder(num_particles=60, has_driven=True)
    names = dict(model.named_parameters())
    assert {name for name, _ in with_actions.named_parameters()} - set(names) == {"unseen_driven"}
    assert all(torch.equal(value, names[name]) for name, value in with_actions.named_parameters() if name in names)


def test_what_no_camera_sees_looks_as_was_learned() -> None:
    model = encoder(num_particles=60, has_driven=True)
    away = motion()[:1].mapped(lambda values: values)
    away = replace(away, positions=away.positions + 50.0)
    driven = encoded(model, replace(ball_frames(1), driven=away)).driven
    assert driven is not None and torch.equal(driven.features, model.unseen_driven.expand_as(driven.features))


# -- dynamics ----------------------------------------------------------------------------------------------------------


def stage(option: str, *words: str) -> AbstractDynamics:
    common = ["scene=demo", "feature_dim=5", "data.folder=nowhere", "run.folder=nowhere", *words]
    section = compose("train", [f"dynamics={option}", "actions=true", *common])["dynamics"]
    torch.manual_seed(1)
    return build(section, AbstractDynamics, "dynamics").double().eval()


def rod(place: tuple[float, float, float], step: tuple[float, float, float]) -> Driven:
    """A small driven ball of points and where it goes (batch axis of 1)."""
    points, normals = ball_points(40)
    points = (points - torch.tensor(CENTER).double()) * 0.2 + torch.tensor(place).double()
    made = Driven.from_arrays(points[None], normals[None]).to(torch.float64)
    return replace(made, next_positions=made.positions + torch.tensor(step).double(), next_normals=made.normals)


def next_positions(dynamics: AbstractDynamics, driven: Driven | None, with_driven: bool = True) -> torch.Tensor:
    previous, current = ball_particles(1, 80, 5)
    current = replace(current, driven=driven if with_driven else None)
    keys = RandomKeys.fixed(1)
    memory = dynamics.initialize(previous, current, keys)
    return dynamics(previous, current, memory, keys, 0)[0].positions


WORDS = {"inertial": [], "hierarchical_gnn_small": ["dynamics.num_abstract_nodes=80"]}


@pytest.mark.parametrize("option", WORDS)
def test_the_action_is_an_input(option: str) -> None:
    dynamics = stage(option, *WORDS[option])
    # Beside the ball (which goes on by its own velocity), into it.
    place = (CENTER[0] + VELOCITY[0] - RADIUS - 0.03, CENTER[1] + VELOCITY[1], CENTER[2] + VELOCITY[2])
    still, pushed = (next_positions(dynamics, rod(place, step)) for step in ((0, 0, 0), (0.1, 0, 0)))
    assert not torch.allclose(still, pushed, atol=1e-6)
    without = next_positions(dynamics, None)
    far = next_positions(dynamics, rod((9.0, 0, 0), (0.1, 0, 0)))
    assert torch.equal(without, far), "what is out of reach must not count"


def test_the_friction_of_what_is_driven_has_a_gradient_also_where_it_touches_nothing() -> None:
    dynamics = stage("inertial").train()
    for driven in (rod((9.0, 0, 0), (0.1, 0, 0)), None):
        dynamics.zero_grad()
        next_positions(dynamics, driven).sum().backward()
        assert dynamics.log_driven_friction.grad is not None and dynamics.log_driven_friction.grad == 0


@pytest.mark.parametrize("option", [*WORDS, "persistence"])
def test_a_model_without_actions_has_no_inputs_for_them(option: str) -> None:
    words = WORDS.get(option, [])
    taking = stage(option, *words)
    torch.manual_seed(1)
    section = compose(
        "train",
        [f"dynamics={option}", "scene=demo", "feature_dim=5", "data.folder=nowhere", "run.folder=nowhere", *words],
    )["dynamics"]
    plain = build(section, AbstractDynamics, "dynamics").double().eval()
    before = dict(taking.named_parameters())
    assert all(torch.equal(value, before[name]) for name, value in plain.named_parameters())
    assert len(before) >= len(dict(plain.named_parameters()))
    place = (CENTER[0] - RADIUS, CENTER[1], CENTER[2])
    driven = rod(place, (0.1, 0, 0))
    assert torch.equal(next_positions(plain, driven), next_positions(plain, None))


def test_the_graph_network_with_fixed_shapes_gives_the_same() -> None:
    words = ["dynamics.num_abstract_nodes=80", "dynamics.r_s=0.3"]
    place = (CENTER[0] - RADIUS, CENTER[1], CENTER[2])
    driven = rod(place, (0.1, 0, 0))
    plain = next_positions(stage("hierarchical_gnn_small", *words), driven)
    fixed = next_positions(stage("hierarchical_gnn_small", *words, "dynamics.edge_capacity=9000"), driven)
    assert torch.allclose(plain, fixed, atol=1e-12)


# -- simulator ---------------------------------------------------------------------------------------------------------


class Follows(PersistenceDynamics):
    """Everything moves as the first driven point does."""

    has_driven = True

    def forward(self, previous, current, memory, keys, rollout_step):
        driven = current.driven
        step = (driven.next_positions - driven.positions)[:, :1]
        return replace(current, positions=current.positions + step, driven=None), memory


def simulator(dynamics: AbstractDynamics | None = None, has_driven: bool = True) -> Simulator:
    torch.manual_seed(0)
    made = Simulator(
        encoder=encoder(num_particles=60, has_driven=has_driven),
        dynamics=dynamics or Follows(),
        renderer=renderer(),
        location_noise=0.0,
        checkpoint_dynamics=False,
        pixel_gradient_to_motion=1.0,
    )
    return made.double()


def scene_of(model: Simulator, given: Driven | None = None) -> Scene:
    frames = [ball_frames(1, time) for time in (0.0, 1.0)]
    rgb, depth = (torch.stack([getattr(frame, name)[0] for frame in frames]) for name in ("rgb", "depth"))
    return model.encode(rgb, depth, ring_cameras(), driven=given)


def test_each_step_is_given_where_what_is_driven_goes() -> None:
    model, given = simulator(), motion()
    scene = scene_of(model, given[:2])
    states = model.rollout(scene, NUM_STEPS, driven=given[2:])
    for step, state in enumerate(states):
        expected = scene.current.positions + (step + 1) * torch.tensor(VELOCITY).double()
        assert torch.allclose(state.positions, expected, atol=1e-6)
        assert state.driven is not None and torch.allclose(state.driven.positions[0], given.positions[step + 2])
        assert state.driven.features is not None  # it is drawn wherever it goes
    stepped = model.start(scene)
    for step in range(NUM_STEPS):
        stepped = stepped.step(given[step + 2 : step + 3])
        assert torch.equal(stepped.particles.positions, states[step].positions)


def test_without_a_motion_what_is_driven_stays() -> None:
    model, given = simulator(), motion()
    scene = scene_of(model, given[:2])
    for state in (*model.rollout(scene, 2), model.start(scene).step().particles):
        assert torch.equal(state.positions, scene.current.positions)
        assert state.driven is not None and torch.equal(state.driven.positions, scene.current.driven.positions)


def test_what_is_driven_is_drawn_where_it_is() -> None:
    model, given = simulator(), motion()
    scene = scene_of(model, given[:2])
    drawn = model.render([scene.current], ring_cameras())
    gone = model.render([replace(scene.current, driven=None)], ring_cameras())
    assert not torch.allclose(drawn, gone)


def candidates(count: int) -> Driven:
    """Motions from the current place on, each with a velocity of its own (axes ``batch step driven``)."""
    draw = torch.Generator().manual_seed(3)
    steps = 0.05 * torch.randn(count, 3, generator=draw, dtype=torch.float64)
    base = motion()[2:]
    offset = torch.arange(NUM_STEPS, dtype=torch.float64)[None, :, None, None] * steps[:, None, None]
    spread = base.mapped(lambda values: values.expand(count, *values.shape))
    return replace(spread, positions=spread.positions + offset)


@pytest.mark.parametrize("option", ["follows", *WORDS])
def test_many_motions_from_one_scene_are_single_rollouts_side_by_side(option: str) -> None:
    model = simulator(Follows() if option == "follows" else stage(option, *WORDS[option]))
    if option == "inertial":
        model.encoder = encoder(
            num_particles=60, has_driven=True, use_normals=True,
        )  # fmt: skip
    scene = scene_of(model, motion()[:2])
    many = candidates(5)
    together = model.rollout(scene, NUM_STEPS, driven=many)
    stepped = model.start(scene)
    for step in range(NUM_STEPS):
        stepped = stepped.step(many[:, step : step + 1])
    assert torch.allclose(stepped.particles.positions, together[-1].positions, atol=1e-12)
    for number in range(5):
        alone = model.rollout(scene, NUM_STEPS, driven=many[number])
        for one, all_of_them in zip(alone, together, strict=True):
            assert torch.allclose(one.positions[0], all_of_them.positions[number], atol=1e-10)


def test_expanding_copies_nothing() -> None:
    tree = expanded(motion()[:1], 7)
    assert tree.positions.shape[0] == 7 and tree.positions.stride(0) == 0
    assert expanded(RandomKeys(1, 2, [5]), 3).sample_index == [5, 5, 5]
    assert expanded(None, 3) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda given: given[:2], "has 2 steps, but 4 are to be predicted"),
        (lambda given: given.mapped(lambda v: v[:, :-1]), "of 119 points, that of the scene of 120"),
        (lambda given: replace(given, positions=given.positions * torch.nan), "not finite"),
        (lambda given: replace(given, normals=given.normals * 2), "not of unit length"),
        (lambda given: replace(given, positions=given.positions + 1.0), f"the most is {MAX_STEP} m"),
        (lambda given: replace(given, positions=1000 * given.positions), "in metres"),
    ],
)
def test_a_motion_that_cannot_be_right_is_refused(change: Any, message: str) -> None:
    model, given = simulator(), motion()
    scene = scene_of(model, given[:2])
    with pytest.raises(ActionError, match=message):
        model.rollout(scene, NUM_STEPS, driven=change(given[2:]))


def test_a_jump_names_its_step() -> None:
    model, given = simulator(), motion()
    later = given.positions.clone()
    later[4:] += 2.0
    with pytest.raises(ActionError, match="in step 2 of the motion"):
        model.rollout(scene_of(model, given[:2]), NUM_STEPS, driven=replace(given, positions=later)[2:])


def test_what_is_driven_must_be_where_the_cameras_see_it() -> None:
    model, given = simulator(), motion()
    elsewhere = replace(given, positions=given.positions + torch.tensor([0.0, 0.0, 0.4]).double())
    with pytest.raises(ActionError, match="see through .* of the driven points"):
        scene_of(model, elsewhere[:2])
    with pytest.raises(ActionError, match="not finite in the observed frames"):
        scene_of(model, replace(given, positions=given.positions * torch.inf)[:2])
    with pytest.raises(ValueError, match="for both frames"):
        scene_of(model, given[:3])


def test_a_model_without_actions_says_so() -> None:
    model = simulator(PersistenceDynamics(), has_driven=False)
    with pytest.raises(ActionError, match="trained without actions"):
        scene_of(model, motion()[:2])
    assert issubclass(ActionError, ConfigError)
    with pytest.raises(ActionError, match="encoded without what is driven"):
        model.rollout(scene_of(model), NUM_STEPS, driven=motion()[2:])


def test_the_number_of_motions_fits_the_scene() -> None:
    model = simulator()
    scene = scene_of(model, motion()[:2])
    two = Scene(*(expanded(part, 2) for part in (scene.previous, scene.current)))
    with pytest.raises(ActionError, match="3 motions do not fit a batch of 2"):
        model.rollout(two, NUM_STEPS, driven=candidates(3), keys=RandomKeys.fixed(2))
