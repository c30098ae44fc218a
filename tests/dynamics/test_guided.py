"""What a hand moves: a body that goes on as it came, whatever gravity, friction and others would do to it."""

import torch

from tests.dynamics.solids import cube
from tests.dynamics.test_inertial import dynamics, fall, roll, scene
from vpd_lightning.types import Particles

SPEED = torch.tensor([0.02, 0.0, 0.0], dtype=torch.float64)  # metres per step


def two_cubes() -> tuple[Particles, Particles]:
    """A cube that comes along a floor at constant speed, and before it one that stands; their colours differ."""
    points, colors, normals = cube(300, seed=3)
    gap = points.new_tensor([0.3, 0.0, 0.0])
    height = float(-points[:, 2].min()) + 1e-3

    def at(shift):
        both = torch.cat([points - gap / 2 + shift, points + gap])
        hues = torch.cat([torch.ones_like(colors) * points.new_tensor([0.9, 0.8, 0.2]), torch.ones_like(colors) * 0.2])
        made = scene(both, hues, torch.cat([normals, normals]), height, num_floor=400)
        features = torch.cat([made.colors, made.colors[..., :1]], dim=-1)
        return made, features

    found = []
    for made, features in (at(0 * SPEED), at(SPEED)):
        found.append(Particles(made.positions, features, colors=made.colors, moving=made.moving, normals=made.normals))
    return found[0], found[1]


def rolled(share: float | None, num_steps: int = 12) -> torch.Tensor:
    """Return the way of both cubes' centres (step, cube, 3) where the yellow one is guided by so much."""
    model = fall(dynamics(infers_guided=share is not None, num_probes=600, num_contact_substeps=4))
    if share is not None:
        set_guided(model, share)
    previous, current = two_cubes()
    states = roll(model, previous, current, num_steps)
    ways = torch.stack([state.positions[0, :600].unflatten(0, (2, 300)).mean(dim=1) for state in states])
    return ways - current.positions[0, :600].unflatten(0, (2, 300)).mean(dim=1)


def set_guided(model, share: float) -> None:
    """Let the share be that for yellow bodies, and nothing for the others."""

    class Yellow(torch.nn.Module):
        def forward(self, features, weights):
            mean = torch.einsum("bkp,bpf->bkf", weights, features)
            return share * (mean[..., :1] > 0.5).to(features)

    model.guidance = Yellow()


def test_a_guided_body_goes_on_and_what_it_meets_gives_way():
    free, guided = rolled(None), rolled(1.0)

    time = torch.arange(1.0, 13.0, dtype=torch.float64)[:, None]
    torch.testing.assert_close(guided[:, 0], time * SPEED, rtol=0, atol=2e-3)
    assert free[-1, 0, 0] < 0.1, "friction stops the other"
    assert guided[-1, 1, 0] > 0.05 > 0.02 > free[-1, 1, 0], "the one that it meets is pushed along"


def test_without_a_share_it_is_as_if_there_were_no_hand():
    torch.testing.assert_close(rolled(0.0), rolled(None), rtol=0, atol=1e-12)


def test_a_hand_is_learned_from_where_a_body_goes():
    model = fall(dynamics(infers_guided=True))
    previous, current = two_cubes()
    first = model.initialize(previous, current, None).guided
    there = first[0, :, 0][model.initialize(previous, current, None).bodies[0].sum(dim=-1) > 0]
    optimizer = torch.optim.Adam(model.guidance.parameters(), lr=2e-2)
    target = current.positions[0, :300].mean(dim=0) + 3 * SPEED

    for _ in range(40):
        states = roll(model, previous, current, 3)
        loss = (states[-1].positions[0, :300].mean(dim=0) - target).square().sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    memory = model.initialize(previous, current, None)
    torch.testing.assert_close(there, torch.full_like(there, 0.05), rtol=1e-6, atol=0)
    assert memory.guided[0, memory.own[0, 0]] > 0.8
