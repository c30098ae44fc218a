"""Shift, turn and stretch of bodies against closed forms of mechanics."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.dynamics.solids import even_ball, even_cube, random_rotation, rotation_about
from vpd_lightning.dynamics.inertial.body_motion import MAX_STRAIN, BodyMotion, Inertia, body_inertia
from vpd_lightning.dynamics.inertial.materials import MaterialNetwork, Materials, elastic
from vpd_lightning.dynamics.inertial.rigid_motion import rotation_from_spin

EYE = torch.eye(3, dtype=torch.float64)


def inertia_of(points, softness=0.0, ratio=1.0):
    """Of unit mass spread evenly over the points, about the origin."""
    weights = torch.full((1, 1, len(points)), 1 / len(points), dtype=torch.float64)
    center, soft = torch.zeros(1, 1, 3, dtype=torch.float64), torch.full((1, 1, 1), softness, dtype=torch.float64)
    return body_inertia(points[None], center, weights, soft, torch.tensor(ratio, dtype=torch.float64))


def motion(stretch=EYE, strain=None, spin=(0.0, 0.0, 0.0), displacement=(0.0, 0.0, 0.0)):
    return BodyMotion(
        centers=torch.zeros(1, 1, 3, dtype=torch.float64),
        displacements=torch.tensor([[displacement]], dtype=torch.float64),
        spins=torch.tensor([[spin]], dtype=torch.float64),
        stretches=stretch[None, None],
        strains=torch.zeros(1, 1, 3, 3, dtype=torch.float64) if strain is None else strain[None, None],
    )


def at(*values):
    return torch.tensor([[values]], dtype=torch.float64)


def symmetric(seed, size):
    matrix = torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return size * (matrix + matrix.T) / (matrix + matrix.T).norm()


def by_hand(points, ratio=1.0):
    """Second moments and inverse inertia of a thin shell, by loops; with the ridge of two percent of the trace."""
    moments = np.zeros((3, 3))
    for point in points.numpy():
        moments += np.outer(point, point) / len(points)
    moments += (0.02 * np.trace(moments) + 1e-6) * np.eye(3)
    return moments, ratio * np.linalg.inv(np.trace(moments) * np.eye(3) - moments)


def test_a_shell_has_the_inertia_of_the_text_book():
    radius, half = 0.15, 0.2
    ball, cube = even_ball(4000, radius)[0], even_cube(20, half)[0]

    # Thin shells of unit mass: 2/3 r^2 for a ball, 10/9 half^2 for a cube. The ridge of 2 % of the trace of the second
    # moments adds 6 % (4 % of a trace that is 3/2 of it); 1 %: points instead of a surface.
    for points, expected in ((ball, 2 / 3 * radius**2), (cube, 10 / 9 * half**2)):
        turning = torch.linalg.inv(inertia_of(points).inverse_turning[0, 0])
        assert torch.allclose(turning, 1.06 * expected * EYE, rtol=0.01, atol=0.01 * expected)
        ratio = inertia_of(points, ratio=5 / 3).inverse_turning[0, 0]
        assert torch.allclose(ratio, 5 / 3 * inertia_of(points).inverse_turning[0, 0])


def test_a_push_at_the_centre_only_shifts():
    inertia, push = inertia_of(even_cube(6)[0], softness=0.7), at(0.1, -0.2, 0.3)

    change = inertia.push(at(0.0, 0.0, 0.0), push)

    assert torch.equal(change.displacements, push)
    assert (change.spins == 0).all() and (change.strains == 0).all()
    assert inertia.response(at(0.0, 0.0, 0.0), at(0.0, 0.0, 1.0)).item() == 1.0


@pytest.mark.parametrize("seed", range(4))
def test_a_rigid_body_responds_as_newton_and_euler_say(seed):
    draw = np.random.default_rng(seed)
    points = even_cube(5, 0.2)[0] @ random_rotation(seed).T
    arm, direction = 0.15 * draw.normal(size=3), draw.normal(size=3)
    direction /= np.linalg.norm(direction)
    _, inverse = by_hand(points, ratio=0.8)
    lever = np.cross(arm, direction)

    response = inertia_of(points, ratio=0.8).response(at(*arm), at(*direction))
    change = inertia_of(points, ratio=0.8).push(at(*arm), at(*(0.3 * direction)))

    assert response.item() == pytest.approx(1 + lever @ inverse @ lever, rel=1e-9)
    assert np.allclose(change.spins[0, 0].numpy(), 0.3 * inverse @ lever)
    moved = change.displacements[0, 0].numpy() + np.cross(change.spins[0, 0].numpy(), arm)
    assert moved @ direction == pytest.approx(0.3 * response.item(), rel=1e-9)


@pytest.mark.parametrize("softness", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_response_is_how_far_the_pushed_point_goes(softness, seed):
    draw = np.random.default_rng(seed)
    inertia = inertia_of(even_cube(5, 0.2)[0] * torch.tensor([1.0, 0.5, 0.8], dtype=torch.float64), softness)
    arm, direction = 0.15 * draw.normal(size=3), draw.normal(size=3)
    direction /= np.linalg.norm(direction)

    change = inertia.push(at(*arm), at(*direction))
    spin, strain = change.spins[0, 0].numpy(), change.strains[0, 0].numpy()
    moved = direction + np.cross(spin, arm) + strain @ arm

    assert inertia.response(at(*arm), at(*direction)).item() == pytest.approx(moved @ direction, rel=1e-9)
    assert np.allclose(strain, strain.T)
    assert (strain == 0).all() == (softness == 0)


def test_the_response_never_falls_below_one():
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(1, 1, 3, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 0.1, 0.01]).double()
    inertia = inertia_of(torch.cat([points[0, 0][None], -points[0, 0][None]]), softness=1.0)
    arms, ways = torch.randn(2, 200, 3, generator=generator, dtype=torch.float64)
    ways = ways / ways.norm(dim=-1, keepdim=True)
    for arm, way in zip(arms, ways, strict=True):
        assert inertia.response(arm[None, None], way[None, None]).item() >= 1 - 1e-12


def test_gathered_is_the_inertia_of_the_bodies_asked_for():
    values = torch.arange(3, dtype=torch.float64)
    matrices = values[None, :, None, None] * EYE
    inertia = Inertia(matrices, 2 * matrices, values[None, :, None])

    other = inertia.gathered(torch.tensor([[2, 0, 2, 1]]))

    assert other.softness.flatten().tolist() == [2, 0, 2, 1]
    assert torch.equal(other.inverse_turning[0, 0], 2 * EYE) and torch.equal(other.inverse_moments[0, 3], 2 * EYE)


def test_a_rigid_motion_turns_offsets_by_its_rotation_alone():
    turn = rotation_about([1, 2, 3], 0.7)
    axis = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64) / math.sqrt(14)
    spun = motion(spin=(2 * math.tan(0.35) * axis).tolist())
    offsets, own = torch.randn(1, 9, 3, dtype=torch.float64), torch.zeros(1, 9, dtype=torch.int64)

    assert torch.equal(spun.deformation()[0, 0], EYE)
    assert torch.allclose(spun.turned(offsets, own)[0], offsets[0] @ turn.T, atol=1e-12)


def test_rigid_bodies_keep_identity_exactly():
    state = motion(spin=(0.3, -0.2, 0.5))
    for _ in range(300):
        stretch, strain = state.following_stretches()
        # Turned identities round; what is carried on must not drift.
        state = replace(state, stretches=stretch, strains=strain)
    assert (state.stretches[0, 0] - EYE).abs().max() < 1e-13
    assert (state.strains == 0).all()
    still = motion()
    assert torch.equal(still.following_stretches()[0][0, 0], EYE)
    ones, own = torch.ones(1, 2, 3).double(), torch.zeros(1, 2, dtype=torch.int64)
    assert torch.equal(still.turned(ones, own), ones)


def test_a_stretch_takes_offsets_from_the_old_shape_to_the_new():
    old, strain = EYE + symmetric(0, 0.1), symmetric(1, 0.05)
    first, own = torch.randn(1, 7, 3, dtype=torch.float64), torch.zeros(1, 7, dtype=torch.int64)

    moved = motion(old, strain).turned(first @ old, own)

    assert torch.allclose(moved, first @ (old + strain), atol=1e-12)


@pytest.mark.parametrize("size", [0.0, 0.1, 0.29, 0.31, 0.6, 5.0, 1e6])
def test_a_stretch_nears_its_limit_and_never_passes_it(size):
    strain = symmetric(2, size) if size else torch.zeros(3, 3, dtype=torch.float64)

    off = (motion(strain=strain).limited_strains())[0, 0]

    assert off.norm() <= MAX_STRAIN * (1 + 1e-12)
    assert off.norm() <= strain.norm() + 1e-12
    if size < MAX_STRAIN / 2:
        assert torch.allclose(off, strain, atol=1e-15)
    assert torch.linalg.eigvalsh(EYE + off).min() > 0.3  # so that the inverse stays tame


def test_strains_have_finite_gradients_at_rest_and_beyond_the_limit():
    for strain in (torch.zeros(3, 3).double(), symmetric(3, 0.3), symmetric(3, 40.0)):
        leaf = strain.clone().requires_grad_()
        state = motion(strain=leaf, spin=(0.1, 0.0, 0.0))
        (state.deformation().square().sum() + state.following_stretches()[0].sum()).backward()
        assert torch.isfinite(leaf.grad).all()


def test_limited_strains_have_the_gradients_of_finite_differences():
    for size in (0.1, 0.45):
        stretch = EYE + symmetric(4, 0.1)
        strain = symmetric(5, size).requires_grad_()
        assert torch.autograd.gradcheck(lambda s: motion(stretch, s).limited_strains(), strain)  # noqa: B023


def soft(stiffness, damping):
    one = torch.ones(1, 1, 1, dtype=torch.float64)
    return Materials(one, one, one, one, stiffness * one, damping * one)


@pytest.mark.parametrize(("stiffness", "damping"), [(0.25, 0.1), (0.04, 0.0), (0.9, 0.3), (0.01, 0.5)])
def test_a_stretch_swings_back_as_the_damped_recurrence_says(stiffness, damping):
    start = 0.05
    state, materials = (
        motion(EYE + start * torch.diag(torch.tensor([1.0, -0.5, 0.0]).double())),
        soft(stiffness, damping),
    )
    # v' = (1 - d) v - k x, x' = x + v': the roots of z^2 - (2 - d - k) z + (1 - d) = 0 give frequency and decay.
    roots = np.roots([1, -(2 - damping - stiffness), 1 - damping]).astype(complex)
    coefficients = np.linalg.solve(
        np.vstack([np.ones(2), roots]), np.array([start, start * (1 - stiffness)], dtype=complex)
    )
    for step in range(1, 60):
        state = replace(state, strains=elastic(state, materials))
        stretch, strain = state.following_stretches()
        state = replace(state, stretches=stretch, strains=strain)
        expected = (coefficients @ roots**step).real
        assert stretch[0, 0, 0, 0].item() - 1 == pytest.approx(expected, abs=1e-12)
        assert stretch[0, 0, 1, 1].item() - 1 == pytest.approx(-expected / 2, abs=1e-12)


def test_any_stiffness_and_damping_below_one_is_stable():
    for stiffness in (0.0, 0.3, 0.999999):
        for damping in (0.0, 0.5, 1.0):
            state, materials = motion(EYE + symmetric(6, 0.2), symmetric(7, 0.1)), soft(stiffness, damping)
            for _ in range(400):
                state = replace(state, strains=elastic(state, materials))
                stretch, strain = state.following_stretches()
                state = replace(state, stretches=stretch, strains=strain)
                assert (stretch[0, 0] - EYE).norm() <= MAX_STRAIN + 1e-9


@pytest.mark.parametrize("count", [0, 1, 2])
def test_bodies_of_no_or_hardly_any_particles_resist_finitely(count):
    positions = torch.randn(1, 5, 3, dtype=torch.float64, requires_grad=True)
    weights = (torch.arange(5) < count).double()[None, None] / max(1, count)
    center = (weights[..., None] * positions[:, None]).sum(dim=2)
    inertia = body_inertia(positions, center, weights, at(0.5), torch.ones(()).double())

    total = inertia.response(at(0.1, 0.0, 0.0), at(0.0, 0.0, 1.0)).sum() + inertia.inverse_turning.sum()
    total.backward()

    assert torch.isfinite(total) and torch.isfinite(positions.grad).all()


def test_a_spin_is_turned_with_its_body_and_a_stretch_with_it():
    stretch, spin = EYE + symmetric(8, 0.2), torch.tensor([0.4, 0.1, -0.3], dtype=torch.float64)
    rotation = rotation_from_spin(spin)

    following, _ = motion(stretch, spin=spin.tolist()).following_stretches()

    assert torch.allclose(following[0, 0], rotation @ stretch @ rotation.T, atol=1e-12)


def network(is_soft, max_friction=None):
    return MaterialNetwork(feature_dim=5, hidden_dim=8, is_soft=is_soft, max_friction=max_friction).double()


@pytest.mark.parametrize(("is_soft", "max_friction"), [(True, None), (False, None), (False, 1.0)])
def test_before_training_all_bodies_are_of_one_material(is_soft, max_friction):
    features = torch.randn(2, 9, 5, dtype=torch.float64)
    shares = torch.rand(2, 3, 9, dtype=torch.float64)
    made = network(is_soft, max_friction)(features, shares / shares.sum(dim=-1, keepdim=True))

    expected = {"friction": 0.5, "restitution": 0.1, "density": 1.0, "softness": 0.01 * is_soft}
    for name, value in (expected | {"stiffness": 0.25, "damping": 0.1}).items():
        values = getattr(made, name)
        assert values.shape == (2, 3, 1)
        assert torch.allclose(values, torch.full_like(values, value), atol=1e-7), name  # the bias is of float32


def test_a_limit_of_friction_below_that_of_the_start_is_refused():
    with pytest.raises(ValueError, match=r"max_friction must be more than 0\.5 or null, got 0\.4"):
        network(is_soft=False, max_friction=0.4)


@pytest.mark.parametrize(("max_friction", "most_friction"), [(None, math.exp(2)), (1.0, 1.0)])
def test_materials_stay_within_their_ranges_and_rigid_is_exactly_rigid(max_friction, most_friction):
    model = network(is_soft=False, max_friction=max_friction)
    torch.nn.init.normal_(model.network[-1].weight, std=100.0)
    features = 50 * torch.randn(4, 30, 5, dtype=torch.float64)
    made = model(features, torch.eye(30, dtype=torch.float64).expand(4, -1, -1))

    assert (made.softness == 0).all()
    for name in ("restitution", "stiffness", "damping"):
        values = getattr(made, name)
        assert ((values >= 0) & (values <= 1)).all() and values.max() > 0.5 > values.min(), name
    for name, top in (("friction", most_friction), ("density", math.exp(3))):
        assert getattr(made, name).max() <= top * (1 + 1e-12) and getattr(made, name).min() > 0, name


def test_materials_are_those_of_the_mean_feature_and_empty_places_are_finite():
    model = network(is_soft=True)
    torch.nn.init.normal_(model.network[-1].weight)
    features = torch.randn(1, 6, 5, dtype=torch.float64, requires_grad=True)
    shares = torch.tensor([[[0.5, 0.5, 0, 0, 0, 0], [0, 0, 0.25, 0.75, 0, 0], [0] * 6]], dtype=torch.float64)

    made = model(features, shares)
    mean = torch.stack([features[0, :2].mean(0), 0.25 * features[0, 2] + 0.75 * features[0, 3]])
    alone = model(mean[None], torch.eye(2, dtype=torch.float64)[None])
    sum(getattr(made, name).sum() for name in vars(made)).backward()

    assert torch.allclose(made.friction[:, :2], alone.friction) and torch.allclose(made.damping[:, :2], alone.damping)
    assert torch.isfinite(features.grad).all() and (features.grad[0, 4:] == 0).all()
    assert (features.grad[0, :4].abs().sum(-1) > 0).all()
