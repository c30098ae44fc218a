"""Every exact switch of the paper's renderer, against all of them off: the paper written plainly."""

import pytest
import torch

from tests.renderer.small_renderer import assert_same, gradients_of, rays_of, renderer_of, scene
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.rays.particle_search import morton_sorted
from vpd_lightning.types import Particles

OFF = {"features_backend": "torch", "sort_particles": False, "reuse_coarse": False, "checkpoint_chunks": False}
SWITCHES = [
    {"features_backend": "auto"},
    {"sort_particles": True},
    {"reuse_coarse": True},
    {"checkpoint_chunks": True},
    {"features_backend": "auto", "sort_particles": True, "reuse_coarse": True, "checkpoint_chunks": True},
    {"features_backend": "auto", "sort_particles": True, "reuse_coarse": True, "ray_chunk_size": 4},
]


def padded_scene() -> Particles:
    particles = scene()
    return Particles(particles.positions, particles.features, torch.rand(2, 50) < 0.8)


@pytest.mark.parametrize("switches", SWITCHES)
@pytest.mark.parametrize("keys", [None, RandomKeys(0, 3, [0, 1])])
def test_an_exact_switch_changes_neither_picture_nor_gradients(switches: dict, keys: RandomKeys | None) -> None:
    particles, rays = padded_scene(), rays_of()
    plain, switched = renderer_of(**OFF), renderer_of(**(OFF | switches))
    assert_same(plain(particles, rays, keys), switched(particles, rays, keys))
    expected = gradients_of(plain, particles, rays, keys)
    for one, other in zip(gradients_of(switched, particles, rays, keys), expected, strict=True):
        # Only the order of summation differs; the fused sums round their exponentials by themselves.
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 3])
@pytest.mark.parametrize("switches", SWITCHES)
def test_scenes_with_hardly_a_particle_stay_the_same(switches: dict, count: int) -> None:
    particles, rays = scene(count=count), rays_of()
    assert_same(renderer_of(**OFF)(particles, rays, None), renderer_of(**(OFF | switches))(particles, rays, None))


def test_switches_do_not_change_the_state_dict() -> None:
    plain, switched = renderer_of(**OFF), renderer_of(max_radius=1.0)
    assert plain.state_dict().keys() == switched.state_dict().keys()


def test_sorting_keeps_particles_together_and_loses_none() -> None:
    particles = padded_scene()
    tagged = Particles(particles.positions, particles.positions.clone(), particles.mask)
    found = morton_sorted(tagged)
    assert torch.equal(found.positions, found.features)
    for member in range(2):
        before = particles.positions[member][particles.mask[member]]
        after = found.positions[member][found.mask[member]]
        assert not torch.equal(before, after)
        assert {tuple(point) for point in before.tolist()} == {tuple(point) for point in after.tolist()}
        # Consecutive particles of a curve through the cube are closer than those of a random order.
        assert (after[1:] - after[:-1]).norm(dim=-1).mean() < 0.8 * (before[1:] - before[:-1]).norm(dim=-1).mean()
    assert all(values.shape == (0, 3) for values in morton_sorted(scene(count=0)).positions)


def test_the_fine_tier_at_given_places_is_the_fine_tier() -> None:
    renderer, particles, rays = renderer_of(), scene(), rays_of()
    t = (torch.rand(2, 7, 9, dtype=torch.float64) * 3 + 0.7).sort(dim=-1).values
    whole = renderer.render_at(particles, rays, t)
    few = renderer_of(reuse_coarse=False).render_at(particles, rays, t)
    torch.testing.assert_close(whole.rgbs, few.rgbs, rtol=1e-12, atol=1e-12)
    # A sample more that stands for nothing (its interval is empty) leaves the picture alone.
    again = renderer.render_at(particles, rays, torch.cat([t[..., :4], t[..., 3:]], dim=-1))
    torch.testing.assert_close(whole.rgbs, again.rgbs, rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(whole.depths, again.depths, rtol=1e-9, atol=1e-10)


def test_no_rays_are_no_problem() -> None:
    rays = rays_of(count=0)
    for changes in ({}, {"max_radius": 0.3}):
        with torch.no_grad():
            assert renderer_of(**changes)(scene(), rays, None).rgbs.shape == (2, 0, 3)
