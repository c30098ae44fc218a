import torch

from vpd_lightning.dynamics.contact import Contacts, nearest_static_contacts, resolve_contacts
from vpd_lightning.dynamics.rigid_motion import Twists

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def floor(count=20):
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(1, count, 3, generator=generator, dtype=torch.float64) * 2 - 1
    positions[..., 2] = 0
    return positions, UP.expand(1, count, 3), torch.ones(1, count, dtype=torch.bool)


def test_distance_to_a_floor_is_the_height_however_far_apart_its_particles_are():
    probes = torch.tensor([[[0.1, 0.2, 0.3], [0.0, 0.0, -0.05], [-0.4, 0.3, 0.01]]], dtype=torch.float64)

    contacts = nearest_static_contacts(probes, *floor(), far=1.0)

    assert torch.allclose(contacts.distances, probes[..., 2], atol=1e-12)
    assert torch.allclose(contacts.normals, UP.expand(1, 3, 3))


def test_nothing_near_nothing_static_and_unknown_normals_are_no_contact():
    probes = torch.zeros(1, 1, 3, dtype=torch.float64)
    positions, normals, mask = floor()

    for arguments in (
        (positions + 9, normals, mask),
        (positions, torch.zeros_like(normals), mask),
        (positions, normals, torch.zeros_like(mask)),
    ):
        contacts = nearest_static_contacts(probes, *arguments, far=1.0)
        assert contacts.distances.item() == 1.0 and (contacts.normals == 0).all()


def dropping(distances, speed=0.1):
    """Three points of a body around the origin that moves down, with their distances to a floor."""
    positions = torch.tensor([[[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]], dtype=torch.float64)
    twists = Twists(
        centers=torch.zeros(1, 1, 3, dtype=torch.float64),
        displacements=-speed * UP[None, None],
        spins=torch.zeros(1, 1, 3, dtype=torch.float64),
    )
    contacts = Contacts(
        distances=torch.tensor([distances], dtype=torch.float64),
        normals=UP.expand(1, 3, 3),
        lateral=torch.zeros(1, 3, dtype=torch.float64),
    )
    return twists, positions, contacts


def resolve(distances, num_iterations=1, inverse_inertia=100.0, friction=0.0, sideways=0.0):
    twists, positions, contacts = dropping(distances)
    aside = torch.tensor([0.0, sideways, 0.0], dtype=torch.float64)
    twists = Twists(twists.centers, twists.displacements + aside, twists.spins)
    return twists, resolve_contacts(
        twists,
        positions,
        contacts,
        torch.ones(1, 1, 3, dtype=torch.bool),
        inverse_inertia * torch.eye(3, dtype=torch.float64)[None, None],
        torch.tensor(friction, dtype=torch.float64),
        num_iterations=num_iterations,
        max_depth=0.06,
    )


def test_a_body_that_touches_nothing_moves_on_untouched():
    before, after = resolve([0.5, 0.5, 0.5])

    assert torch.equal(after.displacements, before.displacements) and torch.equal(after.spins, before.spins)


def test_the_impulse_at_one_point_is_that_of_newton_and_euler():
    # depth 0.08 at r = (0.1, 0, 0): r x n = (0, -0.1, 0), effective mass 1 + 100 * 0.1^2 = 2, impulse 0.04
    before, after = resolve([0.02, 0.5, 0.5])

    assert torch.allclose(after.displacements - before.displacements, 0.04 * UP)
    expected = torch.tensor([0.0, -100 * 0.1 * 0.04, 0.0], dtype=torch.float64)
    assert torch.allclose(after.spins[0, 0], expected)


def test_more_rounds_leave_no_point_inside():
    _, after = resolve([0.02, 0.03, 0.02], num_iterations=30)
    _, positions, contacts = dropping([0.02, 0.03, 0.02])

    turn = torch.linalg.cross(after.spins.expand(1, 3, 3), positions)  # small turns
    ahead = contacts.distances + after.displacements[..., 2] + turn[..., 2]
    assert ahead.min() > -0.005


def test_a_point_deep_inside_is_left_alone():
    before, after = resolve([-0.2, 0.5, 0.5])

    assert torch.equal(after.displacements, before.displacements)


def test_friction_takes_at_most_its_share_of_the_impulse_from_sliding():
    # No inertia to turn: depth 0.08 is the impulse, friction 0.5 allows 0.04 of it against 0.06 of sliding.
    before, after = resolve([0.02, 0.5, 0.5], inverse_inertia=0.0, friction=0.5, sideways=0.06)

    change = (after.displacements - before.displacements)[0, 0]
    assert torch.allclose(change, torch.tensor([0.0, -0.04, 0.08], dtype=torch.float64))


def test_enough_friction_stops_the_sliding_and_never_reverses_it():
    _, after = resolve([0.02, 0.5, 0.5], inverse_inertia=0.0, friction=5.0, sideways=0.06)

    assert torch.allclose(after.displacements[0, 0], torch.tensor([0.0, 0.0, -0.02], dtype=torch.float64), atol=1e-9)
