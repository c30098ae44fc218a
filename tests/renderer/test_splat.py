from importlib.util import find_spec

import pytest
import torch

from benchmarks.plain.splat import splat_candidates
from vpd_lightning.errors import NonFiniteError
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.types import Particles, Rays

SETTINGS = {
    "feature_dim": 5,
    "hidden_dim": 16,
    "num_layers": 2,
    "num_candidates": 8,
    "kernel_scales": [0.02, 0.1],
    "layer_depth": 0.1,
    "near": 0.1,
    "far": 10.0,
    "ray_chunk_size": 7,
    "candidate_backend": "auto",
}
BACKENDS = ["torch", pytest.param("numba", marks=pytest.mark.skipif(not find_spec("numba"), reason="needs numba"))]


def renderer(**changes):
    return SplatRenderer(**{**SETTINGS, **changes}).double()


def particles(batch=2, count=60, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return Particles(
        torch.rand(batch, count, 3, generator=generator, dtype=torch.float64) - 0.5,
        torch.rand(batch, count, 5, generator=generator, dtype=torch.float64),
    )


def rays(batch=2, count=20, seed=1):
    generator = torch.Generator().manual_seed(seed)
    targets = torch.rand(batch, count, 3, generator=generator, dtype=torch.float64) - 0.5
    origins = torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64).expand_as(targets)
    directions = targets - origins
    return Rays(origins, directions / directions.norm(dim=-1, keepdim=True))


def test_colours_and_opacities_are_in_range():
    out = renderer()(particles(), rays(), None)

    assert out.rgbs.shape == (2, 20, 3)
    for values in (out.rgbs, out.opacities):
        assert (values >= 0).all() and (values <= 1).all()
    assert (out.depths > 0).all() and (out.depths <= 10).all()


def test_chunks_do_not_change_the_picture():
    model = renderer()
    whole = renderer(ray_chunk_size=100)
    whole.load_state_dict(model.state_dict())

    assert torch.allclose(model(particles(), rays(), None).rgbs, whole(particles(), rays(), None).rgbs, atol=1e-12)


def test_the_order_of_particles_does_not_matter():
    model, scene = renderer(), particles()
    order = torch.randperm(60)

    shuffled = Particles(scene.positions[:, order], scene.features[:, order])

    assert torch.allclose(model(scene, rays(), None).rgbs, model(shuffled, rays(), None).rgbs, atol=1e-12)


def test_padding_changes_nothing():
    model, scene = renderer(), particles()
    padded = Particles(
        torch.cat([scene.positions, torch.zeros(2, 9, 3, dtype=torch.float64)], 1),
        torch.cat([scene.features, torch.full((2, 9, 5), 7.0, dtype=torch.float64)], 1),
        torch.cat([scene.mask, torch.zeros(2, 9, dtype=torch.bool)], 1),
    )

    assert torch.allclose(model(scene, rays(), None).rgbs, model(padded, rays(), None).rgbs, atol=1e-9)


def test_moving_world_and_rays_together_leaves_the_picture_alone():
    model, scene, lines = renderer(), particles(), rays()
    shift = torch.tensor([5.0, -3.0, 2.0], dtype=torch.float64)

    moved = model(
        Particles(scene.positions + shift, scene.features), Rays(lines.origins + shift, lines.directions), None
    )

    assert torch.allclose(model(scene, lines, None).rgbs, moved.rgbs, atol=1e-9)


def test_what_is_far_behind_the_first_surface_does_not_show():
    model, front = renderer(), particles(count=200)
    behind = Particles(front.positions - torch.tensor([0.0, 0.0, 6.0]), front.features.flip(1))
    both = Particles(torch.cat([front.positions, behind.positions], 1), torch.cat([front.features, behind.features], 1))
    # a dense front: all candidates of a ray belong to it, wherever they lie beside the ray
    assert torch.allclose(model(front, rays(), None).rgbs, model(both, rays(), None).rgbs, atol=1e-6)


def test_without_particles_a_ray_shows_the_background():
    model, lines = renderer(), rays(batch=1)
    empty = Particles(
        torch.zeros(1, 3, 3, dtype=torch.float64),
        torch.zeros(1, 3, 5, dtype=torch.float64),
        torch.zeros(1, 3, dtype=torch.bool),
    )

    out = model(empty, lines, None)

    assert torch.allclose(out.rgbs, torch.sigmoid(model.background(lines.directions)))
    assert (out.opacities == 0).all()


def test_gradients_match_finite_differences(monkeypatch):
    model = renderer(num_candidates=12)
    scene, lines = particles(batch=1, count=12), rays(batch=1, count=3)
    # By design no gradient passes through the place where the front begins: hold it fixed, as the gradient does.
    front = torch.tensor(2.6, dtype=torch.float64).expand(1, 3, 1)
    monkeypatch.setattr(model, "_front", lambda *_: front)

    def colours(positions, features):
        return model(Particles(positions, features), lines, None).rgbs

    inputs = (scene.positions.clone().requires_grad_(), scene.features.clone().requires_grad_())
    assert torch.autograd.gradcheck(colours, inputs, atol=1e-6)


def test_every_parameter_receives_a_finite_gradient():
    model, scene = renderer(), particles()
    scene.positions.requires_grad_()

    model(scene, rays(), None).rgbs.square().sum().backward()

    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
    assert torch.isfinite(scene.positions.grad).all() and scene.positions.grad.abs().sum() > 0


def test_rays_through_a_particle_and_duplicates_stay_finite():
    scene = particles(batch=1, count=4)
    same = Particles(
        scene.positions[:, :1].expand(1, 30, 3).clone().requires_grad_(), scene.features[:, :1].expand(1, 30, 5)
    )
    direction = same.positions[:, :1].detach() - torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64)
    lines = Rays(torch.tensor([[[0.0, 0.0, 3.0]]], dtype=torch.float64), direction / direction.norm())

    model = renderer()
    model(same, lines, None).rgbs.sum().backward()

    assert torch.isfinite(same.positions.grad).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_search_finds_the_candidates_of_the_plain_one(backend):
    model = renderer(num_candidates=24, candidate_backend=backend)
    scene, lines = particles(count=700), rays(count=300)
    scene = Particles(scene.positions, scene.features, torch.arange(700).expand(2, 700) % 7 > 0)

    fast = model._candidates(scene, lines.origins, lines.directions)
    plain = splat_candidates(model, scene, lines.origins, lines.directions)

    assert torch.equal(fast.sort(dim=-1).values, plain.sort(dim=-1).values)


@pytest.mark.skipif(not find_spec("numba"), reason="needs numba")
def test_backends_draw_the_same_picture_and_give_the_same_gradients():
    model, scene, lines = renderer(), particles(count=200), rays(count=60)
    other = renderer(candidate_backend="torch")
    other.load_state_dict(model.state_dict())
    results = []
    for one in (model, other):
        positions = scene.positions.clone().requires_grad_()
        rgbs = one(Particles(positions, scene.features), lines, None).rgbs
        results.append((rgbs, torch.autograd.grad(rgbs.square().sum(), [positions, *one.parameters()])))

    # float64; the order of a ray's candidates changes the order of sums
    torch.testing.assert_close(results[0], results[1], rtol=1e-8, atol=1e-9)


def test_a_particle_that_is_not_finite_is_refused_by_name():
    scene = particles()
    scene.positions[0, 3, 1] = float("nan")

    with pytest.raises(NonFiniteError, match="in positions"):
        renderer()(scene, rays(), None)


@pytest.mark.parametrize(
    "changes", [{"kernel_scales": [0.0]}, {"layer_depth": 0.0}, {"num_candidates": 0}, {"near": 3.0, "far": 2.0}]
)
def test_wrong_settings_are_refused(changes):
    with pytest.raises(ValueError):
        renderer(**changes)
