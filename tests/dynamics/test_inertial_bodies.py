"""Several bodies in one scene of the inertial dynamics."""

from dataclasses import replace

import pytest
import torch

from tests.dynamics.solids import cube
from tests.dynamics.test_inertial import dynamics, roll, scene


def two_cubes(gap):
    """One cube flies at another that is at rest; both are above the floor and fall freely with the camera."""
    parts = [cube(120, seed=6), cube(120, seed=7)]
    places = torch.tensor([[0.0, 0.0, 0.0], [0.3 + gap, 0.0, 0.0]], dtype=torch.float64)
    points = torch.cat([part[0] + place for part, place in zip(parts, places, strict=True)])
    colors, normals = (torch.cat([part[index] for part in parts]) for index in (1, 2))
    came = torch.zeros(240, 3, dtype=torch.float64)
    came[:120, 0] = 0.06
    return scene(points - came, colors, normals, num_floor=20), scene(points, colors, normals, num_floor=20)


def test_a_body_strikes_another_and_what_they_carry_is_shared():
    previous, current = two_cubes(gap=0.1)
    model = dynamics(num_probes=240)
    torch.nn.init.constant_(model.forces.damping.bias, 30.0)
    first, second = slice(0, 120), slice(120, 240)

    states = roll(model, previous, current, 6)

    speed = [(states[-1].positions - states[-2].positions)[0, part, 0].mean().item() for part in (first, second)]
    assert speed[1] > 0.02 and speed[0] < 0.045
    assert sum(speed) == pytest.approx(0.06, abs=0.012)  # masses are guessed, and points turn with bodies
    reach = states[-1].positions[0, first, 0].max() - states[-1].positions[0, second, 0].min()
    assert reach < 0.02


def test_bodies_do_not_know_of_each_other_before_they_touch():
    previous, current = two_cubes(gap=0.6)

    states = roll(dynamics(num_probes=240), previous, current, 2)

    assert (states[-1].positions - current.positions)[0, 120:240].norm(dim=-1).max() < 2e-3


def test_more_bodies_than_places_and_no_bodies_are_borne():
    previous, current = two_cubes(gap=0.5)
    for num_bodies in (1, 2, 6):
        states = roll(dynamics(num_bodies=num_bodies), previous, current, 2)
        assert torch.isfinite(states[-1].positions).all()


@pytest.mark.parametrize(("gap", "interacts"), [(0.4, False), (0.05, True)])
def test_learned_forces_on_a_body_depend_on_others_within_the_contact_range_alone(gap, interacts):
    """A body that was left alone by an edit moves as one whose neighbours are out of reach."""
    previous, current = two_cubes(gap)
    model = dynamics(num_probes=240)
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for layer in (model.forces.force, model.forces.damping, model.forces.weight):
            layer.weight.copy_(torch.randn(layer.weight.shape, generator=generator, dtype=torch.float64))
    alone = [replace(frame, mask=frame.mask & ~_second(frame)) for frame in (previous, current)]

    together, by_itself = (roll(model, *frames, 1)[-1].positions[0, :120] for frames in ((previous, current), alone))

    difference = (together - by_itself).norm(dim=-1).max().item()
    assert difference > 1e-4 if interacts else difference < 1e-5  # metres; matches are drawn anew
    assert (together - current.positions[0, :120]).norm(dim=-1).max() > 1e-3


def _second(frame):
    return (torch.arange(frame.num_particles) // 120 == 1)[None]
