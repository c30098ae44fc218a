from dataclasses import replace
from importlib.util import find_spec

import pytest
import torch

from benchmarks.plain.splat import splat_candidates
from tests.reference.reference_splat import splat_picture
from tests.work import TensorWork, counted_calls
from vpd_lightning.config import build
from vpd_lightning.config.migrations import upgraded
from vpd_lightning.errors import NonFiniteError
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.types import HiddenSide, Particles, Rays

SETTINGS = {
    "feature_dim": 5,
    "color_features": True,
    "background_frequencies": 2,
    "hidden_dim": 16,
    "num_layers": 2,
    "num_candidates": 8,
    "surface_scale": 0.1,
    "kernel_scales": [0.2, 1.0],
    "layer_depth": 1.0,
    "near": 0.1,
    "far": 10.0,
    "ray_chunk_size": 7,
    "candidate_backend": "auto",
    "facing_softness": None,
    "has_scenery": False,
    "num_scenery_candidates": 12,
    "elliptic_footprints": True,
    "far_pixels": True,
    "seen_through": True,
    "unseen_ground": True,
    "num_lights": 0,
    "num_occluders": 512,
    "shadow_softness": 0.5,
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


def perturb(model):
    """Move the weights that start at zero, so that a test cannot pass without them."""
    with torch.no_grad():
        model.network[-1].weight += 0.3 * torch.randn_like(model.network[-1].weight)


def test_before_training_a_surface_has_the_colours_of_its_particles():
    axis = torch.linspace(-0.5, 0.5, 41, dtype=torch.float64)  # 2.5 cm apart, under a narrow kernel of 2 cm
    places = torch.cartesian_prod(axis, axis, torch.zeros(1, dtype=torch.float64))[None]
    colors = torch.where(places[..., :1] < 0, *torch.tensor([[[0.9, 0.2, 0.1]], [[0.1, 0.3, 0.8]]]).double()[:, None])
    scene = Particles(places, torch.cat([colors, torch.zeros(1, len(places[0]), 2).double()], dim=-1))
    x = torch.tensor([-0.4, -0.11, 0.11, 0.4], dtype=torch.float64)
    targets = torch.stack([x, torch.full_like(x, 0.013), torch.zeros_like(x)], dim=-1)[None]
    origins = targets + torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
    lines = Rays(origins, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand_as(origins))

    model = renderer()
    out = model(scene, lines, None)

    behind = model.background(lines.directions)
    left = 1 - out.opacities[..., None]
    shown = (out.rgbs - left * behind) / (1 - left)
    expected = torch.tensor([[0.9, 0.2, 0.1]] * 2 + [[0.1, 0.3, 0.8]] * 2, dtype=torch.float64)
    assert (shown[0] - expected).abs().max() < 1e-3


def test_before_training_all_layers_are_equally_opaque():
    """Random opacities let one training in three turn every particle transparent in its first thirty updates."""
    layer = torch.sigmoid(torch.ones((), dtype=torch.float64))
    possible = torch.stack([0 * layer, layer, 1 - (1 - layer) ** 2])
    opacities = renderer()(particles(), rays(count=200), None).opacities
    assert (opacities[..., None] - possible).abs().min(dim=-1).values.max() < 1e-9
    assert opacities.max() > 0.5


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

    assert torch.allclose(out.rgbs, model.background(lines.directions))
    assert (out.opacities == 0).all()


def test_gradients_match_finite_differences(monkeypatch):
    """Of positions, features and all weights; twelve candidates of twelve, so that no choice changes on the way."""
    model = renderer(num_candidates=12, hidden_dim=5, num_layers=1)
    scene, lines = particles(batch=1, count=12), rays(batch=1, count=3)
    # By design no gradient passes through the place where the front begins: hold it fixed, as the gradient does.
    front = torch.tensor(2.6, dtype=torch.float64).expand(1, 3, 1)
    monkeypatch.setattr(model, "_front", lambda *_: front)
    names = [name for name, _ in model.named_parameters()]

    def rendered(positions, features, *weights):
        arguments = (Particles(positions, features), lines, None)
        out = torch.func.functional_call(model, dict(zip(names, weights, strict=True)), arguments)
        return out.rgbs, out.depths, out.opacities

    weights = [parameter.detach().clone().requires_grad_() for parameter in model.parameters()]
    inputs = (scene.positions.clone().requires_grad_(), scene.features.clone().requires_grad_(), *weights)
    # Step 1e-6 in float64: truncation near 1e-12 times the third derivative (1 / 0.02^3 at the narrowest kernel).
    assert torch.autograd.gradcheck(rendered, inputs, eps=1e-6, atol=1e-6)


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


def sparse_scene(count, dtype=torch.float64):
    """Return two scenes of ``count`` slots, of which every fourth of the second one is padding with nonsense."""
    scene = particles(count=count, seed=count)
    mask = torch.ones(2, count, dtype=torch.bool)
    mask[1, ::4] = False
    junk = torch.where(mask[..., None], 0.0, 1e6)
    return Particles(scene.positions + junk, scene.features + junk, mask).to(dtype)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("count", [0, 1, 5, 7, 8, 9, 300])
@pytest.mark.parametrize("starts", [True, False])
def test_picture_equals_the_plain_one_for_any_number_of_particles(backend, count, starts):
    model = renderer(candidate_backend=backend, color_features=starts, background_frequencies=2 * starts)
    perturb(model)
    scene, lines = sparse_scene(count), rays(count=40)

    fast, plain = model(scene, lines, None), splat_picture(model, scene, lines)

    # float64: sums of a dozen terms in another order, through three layers
    for name in ("rgbs", "depths", "opacities"):
        torch.testing.assert_close(getattr(fast, name), getattr(plain, name), rtol=0, atol=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_float32_is_near_the_plain_picture_in_float64(backend):
    model, lines = renderer(candidate_backend=backend).float(), rays(count=40)
    scene = sparse_scene(300, torch.float32)

    fast, plain = model(scene, lines.to(torch.float32), None), splat_picture(model, scene, lines.to(torch.float32))

    # Places 3 m from the camera are known to 2e-7 m. A kernel of 0.02 m turns that, for candidates 0.3 m beside the
    # ray, into 0.3 * 2e-7 / 0.02^2 = 2e-4 in a logarithm; colours and opacities move by less than a quarter of that.
    assert (fast.rgbs - plain.rgbs).abs().max() < 1e-4
    assert (fast.opacities - plain.opacities).abs().max() < 1e-4
    assert (fast.depths - plain.depths).abs().max() < 1e-4 * model.far  # opacity times the distance to the far plane


@pytest.mark.parametrize("count", [1, 5, 60])
def test_what_is_behind_the_camera_counts_for_nothing(count):
    """Also where all that is in front is far beside the ray, and what is behind fills the other candidates."""
    model, lines = renderer(), rays(count=20)
    scene = particles(count=count)
    there = Particles(scene.positions + torch.tensor([4.0, 0.0, 0.0]), scene.features)
    behind = Particles(scene.positions[:, :7] + torch.tensor([0.0, 0.0, 6.0]), scene.features[:, :7] + 3)
    both = Particles(torch.cat([there.positions, behind.positions], 1), torch.cat([there.features, behind.features], 1))

    assert torch.allclose(model(there, lines, None).rgbs, model(both, lines, None).rgbs, atol=1e-12)


def test_a_ray_with_all_particles_behind_it_shows_the_background():
    model, scene, lines = renderer(), particles(), rays()
    behind = Particles(scene.positions + torch.tensor([0.0, 0.0, 6.0]), scene.features.clone().requires_grad_())

    out = model(behind, lines, None)

    assert torch.allclose(out.rgbs, model.background(lines.directions), atol=1e-12)
    assert (out.opacities == 0).all() and (out.depths == model.far).all()
    gradient, *_ = torch.autograd.grad(out.rgbs.sum(), behind.features)
    assert torch.equal(gradient, torch.zeros_like(gradient))


@pytest.mark.parametrize("backend", BACKENDS)
def test_fifty_thousand_particles_take_neither_long_nor_much_memory(backend):
    model = renderer(candidate_backend=backend, ray_chunk_size=256).float()
    scene, lines = particles(batch=1, count=50_000).to(torch.float32), rays(batch=1, count=1024).to(torch.float32)

    model(scene, Rays(lines.origins[:, :1], lines.directions[:, :1]), None)  # compiles, where nothing was kept
    with torch.no_grad(), TensorWork() as work, counted_calls() as python:
        out = model(scene, lines, None)

    assert torch.isfinite(out.rgbs).all()
    # All pairs would be 51 million numbers; the search scores a quarter of a million at a time (ray_search.py), and a
    # chunk of 256 rays gathers less.
    assert work.largest <= max(1 << 18, scene.features.numel())
    # What takes minutes is a loop of Python over particles, or many passes over all pairs of particles and rays.
    # Counted here: 9,600 operations and 18 numbers per pair by brute force, 860 and 0.2 compiled.
    assert work.operations < 15_000 and python.calls < 500_000
    assert work.numbers < (30 if backend == "torch" else 1) * 50_000 * 1024


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


def test_lengths_of_a_stored_configuration_stay_metres():
    target = "vpd_lightning.renderer.splat.SplatRenderer"
    stored = {key: value for key, value in SETTINGS.items() if key != "surface_scale"}
    in_metres = {**stored, "_target_": target, "kernel_scales": [0.02, 0.1], "layer_depth": 0.1}

    model = build(upgraded({"renderer": in_metres})["renderer"], SplatRenderer, "renderer")

    assert (model.kernel_scales, model.layer_depth) == ([0.02, 0.1], 0.1)


def test_a_particle_that_is_not_finite_is_refused_by_name():
    scene = particles()
    scene.positions[0, 3, 1] = float("nan")

    with pytest.raises(NonFiniteError, match="in positions"):
        renderer()(scene, rays(), None)


@pytest.mark.parametrize(
    "changes",
    [
        {"kernel_scales": [0.0]},
        {"layer_depth": 0.0},
        {"surface_scale": 0.0},
        {"num_candidates": 0},
        {"near": 3.0, "far": 2.0},
    ],
)
def test_wrong_settings_are_refused(changes):
    with pytest.raises(ValueError):
        renderer(**changes)


def test_the_hidden_side_is_drawn_with_the_particles():
    """As if what is guessed were particles: in front of a camera behind the body, at the end of every member's own."""
    model, generator = renderer(facing_softness=0.1), torch.Generator().manual_seed(5)
    perturb(model)
    plain, lines = particles(count=60), rays()
    normals = torch.nn.functional.normalize(torch.randn(2, 60, 3, generator=generator, dtype=torch.float64), dim=-1)
    whole = replace(plain, normals=normals, mask=torch.rand(2, 60, generator=generator) < 0.8)
    parts = {name: getattr(whole, name)[:, 40:] for name in ("positions", "features", "normals", "mask")}
    seen = whole.mapped(lambda values: values[:, :40])

    drawn = model(replace(seen, hidden_side=HiddenSide(**parts)), lines, None)

    expected = model(whole, lines, None)
    assert torch.equal(drawn.rgbs, expected.rgbs) and torch.equal(drawn.depths, expected.depths)
    assert not torch.allclose(drawn.rgbs, model(seen, lines, None).rgbs, atol=1e-3)
