import itertools
from dataclasses import replace
from typing import Any

import pytest
import torch

from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.sleeping import SleepingDynamics
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Driven, Particles

SETTINGS = {
    "location_scale": 0.1,
    "rest_speed": 0.1,  # 1 cm a step
    "rest_drift": 0.2,  # 2 cm
    "rest_steps": 3,
    "wake_radius": 0.25,
    "context_radius": 0.3,
    "link_radius": 0.25,
    "ground_width": 1.0,
    "freeze_features": False,
    "return_to_rest": False,
    "in_training": False,
    "neighbors_backend": "scipy",
}
GRAVITY = -0.0245  # metres per step squared, at 20 frames a second
BODY, VELOCITY = 0, slice(1, 4)  # what the features of the scripted dynamics hold


class Scripted(AbstractDynamics):
    """Bodies of any number that fly under gravity and land without bounce on z = 0; body 0 is the floor.

    A particle's features hold the number of its body and its velocity, so there is no memory, and any part of a scene
    can be advanced. Each step counts as one call and adds 1 to the last feature, as a shadow might.
    """

    def __init__(self, gravity: float = GRAVITY) -> None:
        super().__init__()
        self.gravity, self.num_calls, self.num_seen = gravity, 0, 0

    def forward(
        self, previous: Particles, current: Particles, memory: Any, keys: RandomKeys, rollout_step: int
    ) -> tuple[Particles, Any]:
        self.num_calls, self.num_seen = self.num_calls + 1, int(current.mask.sum())
        features = current.features.clone()
        features[..., -1] += 1
        velocity = features[..., VELOCITY]
        velocity[..., 2] += torch.where(features[..., BODY] > 0, self.gravity, 0.0)
        for member in range(len(features)):
            for body in features[member, :, BODY].unique():
                mine = (features[member, :, BODY] == body) & current.mask[member]
                lowest = (current.positions[member, mine, 2] + velocity[member, mine, 2]).min(dim=0).values
                if mine.any() and body > 0 and lowest < 0:
                    velocity[member, mine] = 0.0
        return replace(current, positions=current.positions + velocity, features=features), memory


def sleeping(inner=None, **changes):
    return SleepingDynamics(dynamics=inner or Scripted(), **{**SETTINGS, **changes}).double().eval()


def grid(width, spacing, height=0.0, at=(0.0, 0.0)):
    line = torch.arange(0, width + 1e-9, spacing, dtype=torch.float64) - width / 2
    x, y = torch.meshgrid(line + at[0], line + at[1], indexing="ij")
    return torch.stack([x, y, torch.full_like(x, height)], dim=-1).reshape(-1, 3)


FLOOR = grid(2.0, 0.1)


def block(height, at=(0.0, 0.0)):
    return torch.cat([grid(0.2, 0.05, height + z, at) for z in (0.0, 0.1, 0.2)])


def scene(*bodies, floor=FLOOR):
    """Particles of the floor and of bodies given as (points, velocity), with the number of the body as a feature."""
    parts = [(floor, (0.0, 0.0, 0.0)), *bodies]
    features = [
        torch.tensor([number, *velocity, 0.0], dtype=torch.float64).expand(len(points), 5)
        for number, (points, velocity) in enumerate(parts)
    ]
    positions = torch.cat([points for points, _ in parts])
    return Particles(positions=positions[None], features=torch.cat(features)[None])


def body(particles, number):
    return (particles.features[..., BODY] == number) & particles.mask


def roll(dynamics, start, num_steps, memory=None, keys=None):
    """Return the states, the first one ``start``, and the memory before each of them and after the last."""
    keys = keys or RandomKeys.fixed(len(start.positions))
    memory = memory or dynamics.initialize(start, start, keys)
    states, memories = [start], [memory]
    previous = start
    for step in range(num_steps):
        following, memory = dynamics(previous, states[-1], memory, keys, step)
        previous = states[-1]
        states.append(following)
        memories.append(memory)
    return states, memories


def test_all_start_awake_and_a_block_at_rest_sleeps_after_rest_steps_with_its_floor():
    dynamics = sleeping()
    states, memories = roll(dynamics, scene((block(0.0), (0, 0, 0))), 10)

    assert [bool(memory.asleep.all()) for memory in memories[:5]] == [False, False, False, True, True]
    assert not memories[2].asleep.any()
    assert dynamics.dynamics.num_calls == SETTINGS["rest_steps"]  # afterwards there is nothing to do
    assert dynamics.last_awake_share == dynamics.last_active_share == 0.0
    assert states[-1] is states[-2]


def test_a_body_that_hovers_or_whose_floor_was_deleted_never_sleeps_though_its_floor_does():
    hovering = scene((block(0.6), (0, 0, 0)))
    hole = FLOOR[FLOOR[:, :2].abs().amax(dim=1) > 0.45]
    deleted = scene((block(0.0), (0, 0, 0)), floor=hole)
    for start in (hovering, deleted):
        _, memories = roll(sleeping(Scripted(gravity=0.0)), start, 30)
        asleep = memories[-1].asleep

        assert not any((memory.asleep & body(start, 1)).any() for memory in memories)
        assert asleep[body(start, 0)].all()


@pytest.mark.parametrize("height", [0.1, 0.6])
def test_a_tossed_body_does_not_sleep_at_its_apex(height):
    start = scene((block(height), (0.0, 0.0, 0.0735)))
    states, memories = roll(sleeping(), start, 30)
    pairs = zip(states, states[1:], strict=False)
    speed = torch.stack([(b.positions - a.positions)[body(start, 1)].norm(dim=-1).max() for a, b in pairs])

    landed = int((speed < 1e-12).nonzero()[1])  # the first such step is the apex
    assert speed[:landed].min() < 1e-12, "the apex is a step without any motion"
    assert not any((memory.asleep & body(start, 1)).any() for memory in memories[: landed + 3])
    assert memories[-1].asleep.all()


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.0), (0.06, 0.02, 0.0)])
def test_the_floor_beneath_a_falling_body_is_awake_before_contact(velocity):
    start = scene((block(2.0, at=(-0.4, 0.0)), velocity))
    states, memories = roll(sleeping(), start, 24)
    floor, falling = body(start, 0), body(start, 1)

    assert memories[4].asleep[floor].all(), "the floor sleeps while the body is far"
    touched = False
    for state, before, after in zip(states, memories, states[1:], strict=False):
        moves = (after.positions - state.positions)[falling].norm(dim=-1).max() > 1e-3
        # Nearness at the start of the step that may bring the contact.
        gap = (state.positions[floor][:, None] - state.positions[falling][None]).norm(dim=-1).amin(dim=1)
        if moves:
            assert not (before.asleep[floor] & (gap < 0.24)).any()
            touched |= bool((gap < 0.2).any())
    assert touched
    assert memories[-1].asleep.all()


def test_a_thrown_body_wakes_a_sleeping_one_before_it_arrives():
    start = scene((block(0.0), (0, 0, 0)), (block(0.0, at=(-0.9, 0.0)), (0.05, 0.0, 0.0)))
    dynamics = sleeping(Scripted(gravity=0.0))
    states, memories = roll(dynamics, start, 16)
    resting, thrown = body(start, 1), body(start, 2)

    assert memories[4].asleep[resting].all()
    gaps = [float(s.positions[resting][:, 0].min() - s.positions[thrown][:, 0].max()) for s in states]
    contact = next(step for step, gap in enumerate(gaps) if gap < 0.05)
    near = states[contact].positions[resting][:, 0] <= states[contact].positions[thrown][:, 0].max() + 0.25
    assert not memories[contact].asleep[resting][near].any()
    assert memories[contact].asleep.any(), "what is far from both sleeps on"


def test_a_sleeper_keeps_its_count_of_steps_at_rest_and_starts_anew_when_it_wakes():
    start = scene((block(0.0), (0, 0, 0)), (block(0.0, at=(-0.9, 0.0)), (0.05, 0.0, 0.0)))
    _, memories = roll(sleeping(Scripted(gravity=0.0)), start, 16)
    still = ~body(start, 2)  # never moves, so that each step awake is a step at rest
    expected, times_fallen = torch.zeros_like(memories[0].num_rested), torch.zeros_like(memories[0].num_rested)

    for before, after in itertools.pairwise(memories):
        woken = still & before.asleep & ~after.asleep
        expected = torch.where(before.asleep, expected, expected + 1).masked_fill(woken, 0)
        torch.testing.assert_close(after.num_rested[still], expected[still], rtol=0, atol=0)
        fallen = still & after.asleep & ~before.asleep
        assert (after.num_rested[fallen] >= SETTINGS["rest_steps"]).all()
        times_fallen += fallen
    assert times_fallen.max() == 2, "some woke in between"


def test_a_steady_slide_slower_than_rest_speed_stays_awake_and_jitter_does_not():
    slide = scene((block(0.0), (0.008, 0.0, 0.0)))  # 8 mm a step; 2 cm are reached before three steps
    _, memories = roll(sleeping(Scripted(gravity=0.0)), slide, 20)
    assert not any((memory.asleep & body(slide, 1)).any() for memory in memories)

    class Jitter(AbstractDynamics):
        def forward(self, previous, current, memory, keys, rollout_step):
            shift = 0.005 if rollout_step % 2 else -0.005  # along each axis: 9 mm
            return replace(current, positions=current.positions + shift), memory

    _, memories = roll(sleeping(Jitter()), slide, 4)
    assert memories[-1].asleep.all()


def test_an_edit_rebuilds_the_memory_and_wakes_everything():
    dynamics = sleeping()
    start = scene((block(0.0), (0, 0, 0)))
    states, memories = roll(dynamics, start, 5)
    assert memories[-1].asleep.all()
    kept = torch.arange(start.num_particles) >= 100
    edited = Particles(states[-1].positions[:, kept], states[-1].features[:, kept])

    with pytest.raises(ValueError, match="initialize after an edit"):
        dynamics(edited, edited, memories[-1], RandomKeys.fixed(1), 5)
    memory = dynamics.initialize(edited, edited, RandomKeys.fixed(1))
    assert not memory.asleep.any() and not memory.num_rested.any()


class Orbit(AbstractDynamics):
    """Body 1 goes round in a circle for ever; all else trembles."""

    def forward(self, previous, current, memory, keys, rollout_step):
        moved = current.positions + 1e-3 * torch.sin(current.positions * 1e3 + rollout_step)
        angle = torch.tensor(0.3 * rollout_step, dtype=torch.float64)
        circle = 0.03 * torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)])
        orbiting = (current.features[..., BODY] == 1)[..., None]
        return replace(current, positions=torch.where(orbiting, current.positions + circle, moved)), memory


def test_sleepers_keep_their_positions_bit_for_bit_for_a_thousand_steps():
    bodies = [(grid(0.2, 0.1, 0.1, at), (0, 0, 0)) for at in ((0.6, 0.6), (-0.6, -0.6))]
    start = scene(*bodies, floor=grid(2.0, 0.2))
    states, memories = roll(sleeping(Orbit()), start, 1000)
    asleep = torch.stack([memory.asleep for memory in memories])
    positions = torch.stack([state.positions for state in states])

    always = asleep[10:].all(dim=0)
    assert always.float().mean() > 0.5 and not asleep[:, body(start, 1)].any()
    assert always[body(start, 2)].all()
    held = positions[10:][:, always]
    assert torch.equal(held, held[:1].expand_as(held))
    moved = positions[1:] != positions[:-1]
    assert not moved[asleep[:-1]].any(), "a step never moves who was asleep before it"


def test_order_of_particles_does_not_matter():
    start = scene((block(0.8), (0.02, 0.0, 0.0)), (block(0.0, at=(0.6, 0.6)), (0, 0, 0)))
    order = torch.randperm(start.num_particles)
    other = Particles(start.positions[:, order], start.features[:, order])
    (states, memories), (mixed, mixed_memories) = roll(sleeping(), start, 16), roll(sleeping(), other, 16)

    for memory, mixed_memory in zip(memories, mixed_memories, strict=True):
        assert torch.equal(mixed_memory.asleep, memory.asleep[:, order])
    assert torch.equal(mixed[-1].positions, states[-1].positions[:, order])


def test_members_of_a_batch_sleep_independently():
    bodies = [(block(0.8), (0.02, 0.0, 0.0)), (block(0.0, at=(0.6, 0.6)), (0, 0, 0)), (block(0.5), (0.0, 0.0, 0.05))]
    alone = [scene(one) for one in bodies]
    junk = torch.tensor([True] * 7 + [False] * (alone[1].num_particles - 7))
    alone[1] = replace(alone[1], mask=~junk[None], positions=torch.where(junk[:, None], 40.0, alone[1].positions))
    together = Particles(*(torch.cat([getattr(s, n) for s in alone]) for n in ("positions", "features", "mask")))
    states, memories = roll(sleeping(), together, 20)

    shares = [memory.asleep.sum(dim=1).tolist() for memory in memories]
    assert any(len(set(share)) == 3 for share in shares), "the members differ"
    for member, start in enumerate(alone):
        own, own_memories = roll(sleeping(), start, 20)
        for a, b in zip(memories, own_memories, strict=True):
            assert torch.equal(a.asleep[member], b.asleep[0])
        valid = start.mask[0]
        assert torch.equal(states[-1].positions[member][valid], own[-1].positions[0][valid])


class Shaken(AbstractDynamics):
    """Body 1 climbs by what is drawn for its member, always by more than a sleeper may; all else stands still."""

    def forward(self, previous, current, memory, keys, rollout_step):
        draws = [torch.rand(3, generator=g, dtype=torch.float64) for g in keys.generators(f"shake/{rollout_step}")]
        shaken = (current.features[..., BODY] == 1)[..., None]
        steps = torch.where(shaken, 0.02 + 0.02 * torch.stack(draws)[:, None], 0.0)
        return replace(current, positions=current.positions + steps), memory


def test_members_of_a_partly_sleeping_batch_draw_with_their_own_keys():
    alone = scene((block(0.6), (0, 0, 0)))
    together = Particles(alone.positions.expand(2, -1, -1), alone.features.expand(2, -1, -1))
    states, memories = roll(sleeping(Shaken()), together, 8, keys=RandomKeys(1, 2, [5, 9]))

    assert memories[4].asleep.any(dim=1).all() and not memories[-1].asleep.all(dim=1).any()
    assert not torch.equal(states[-1].positions[0], states[-1].positions[1]), "the draws differ"
    for member, index in enumerate((5, 9)):
        own, _ = roll(sleeping(Shaken()), alone, 8, keys=RandomKeys(1, 2, [index]))
        for state, expected in zip(states, own, strict=True):
            torch.testing.assert_close(state.positions[member], expected.positions[0], rtol=0, atol=0)


def driven_at(x, step=0.0):
    """A driven point beside the block, and where it goes."""
    place = torch.tensor([[[x, 0.0, 0.1]]], dtype=torch.float64)
    up = torch.tensor([[[0.0, 0.0, 1.0]]], dtype=torch.float64)
    shift = torch.tensor([step, 0.0, 0.0], dtype=torch.float64)
    groups = torch.zeros(1, 1, dtype=torch.int64)
    return Driven(place, up, groups, next_positions=place + shift, next_normals=up)


@pytest.mark.parametrize(
    ("driven", "is_woken"),
    [(driven_at(0.3, 0.05), True), (driven_at(0.3), False), (driven_at(2.0, 0.05), False)],
    ids=["comes near", "stands beside it", "moves far away"],
)
def test_what_is_driven_wakes_what_it_comes_near(driven, is_woken):
    dynamics, start = sleeping(), scene((block(0.0), (0, 0, 0)))
    states, memories = roll(dynamics, start, 6)
    assert memories[-1].asleep.all()
    calls = dynamics.dynamics.num_calls
    current = replace(states[-1], driven=driven)

    following, _ = dynamics(states[-2], current, memories[-1], RandomKeys.fixed(1), 6)

    assert (dynamics.dynamics.num_calls > calls) == is_woken
    assert bool(dynamics.last_awake_share > 0) == is_woken
    assert torch.equal(following.features, current.features) != is_woken, "what woke was not advanced"
