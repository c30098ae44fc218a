"""What the simulator relies on in a renderer."""

from dataclasses import replace

import torch

from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.testing import particle_sets as sets
from vpd_lightning.testing.contract import (
    Contract,
    assert_finite,
    assert_gradients,
    assert_precision,
    assert_same,
    describe_case,
    disturb_global_randomness,
    global_randomness_untouched,
    may_depart,
    summed,
    unchanged,
)
from vpd_lightning.testing.scenes import FEATURE_DIM, ball_particles, keys_for, scene_rays
from vpd_lightning.types import Particles, Rays, RenderedRays


class RendererContract(Contract):
    """Subclass as ``class TestMine(RendererContract)`` and return the renderer from ``build``.

    Build it for features of ``feature_dim`` numbers, the range ``NEAR`` to ``FAR`` and a scene of a metre with about
    10 cm between particles (``ball_particles``, ``scene_rays``). Checks run without keys (evaluation) and, where it
    matters, with keys (training).
    """

    feature_dim: int = FEATURE_DIM

    def build(self) -> AbstractRenderer:
        """Return a new renderer at a small size."""
        return super().build()

    def particles(self, batch_size: int = 2, num_particles: int = 40) -> Particles:
        """Return the particles of the checks; override for another scene."""
        return ball_particles(batch_size, num_particles, self.feature_dim)[1].to(self.device)

    def rays(self, batch_size: int = 2, num_rays: int = 12) -> Rays:
        """Return the rays of the checks."""
        return scene_rays(batch_size, num_rays).to(self.device)

    def test_one_colour_depth_and_opacity_per_ray_in_the_given_precision(self) -> None:
        for dtype in (torch.float32, torch.float64):
            renderer = self.built(dtype)
            for keys in (None, keys_for(2)):
                rendered = renderer(self.particles().to(dtype), self.rays().to(dtype), keys)
                _assert_image(rendered, (2, 12))
                assert_precision(rendered, dtype)

    def test_a_batch_equals_its_members(self) -> None:
        renderer, particles, rays = self.built(), self.particles(3), self.rays(3)
        # Members with different padding must not influence each other in a batch.
        particles = replace(particles, mask=torch.cat([particles.mask[:2], sets.only_valid(particles, 25).mask[2:]]))
        for keys in (None, keys_for(3)):
            together = renderer(particles, rays, keys)
            for index in range(3):
                some = slice(index, index + 1)
                lone_keys = None if keys is None else replace(keys, sample_index=[index])
                lone_rays = Rays(rays.origins[some], rays.directions[some])
                alone = renderer(sets.member(particles, index), lone_rays, lone_keys)
                assert_same(alone, _rows(together, some), self.tolerance)

    def test_a_ray_does_not_see_other_rays(self) -> None:
        renderer, particles, rays = self.built(), self.particles(), self.rays()
        together = renderer(particles, rays, None)
        few = renderer(particles, Rays(rays.origins[:, 3:7], rays.directions[:, 3:7]), None)
        assert_same(few, _columns(together, slice(3, 7)), self.tolerance)

    def test_padding_changes_nothing(self) -> None:
        renderer, particles, rays = self.built(), self.particles(), self.rays()
        for keys in (None, keys_for(2)):
            plain = renderer(particles, rays, keys)
            for where, padded in sets.PADDINGS.items():
                with describe_case(f"with padding {where}"):
                    assert_same(renderer(padded(particles), rays, keys), plain, self.tolerance)

    @may_depart
    def test_order_of_particles_does_not_matter(self) -> None:
        renderer, particles, rays = self.built(), self.particles(), self.rays()
        order = torch.randperm(particles.num_particles, generator=torch.Generator().manual_seed(4)).to(self.device)
        for keys in (None, keys_for(2)):
            plain = renderer(particles, rays, keys)
            assert_same(renderer(sets.reordered(particles, order), rays, keys), plain, self.tolerance)

    @may_depart
    def test_moving_the_world_and_the_camera_leaves_the_picture_alone(self) -> None:
        renderer, particles, rays = self.built(), self.particles(), self.rays()
        for keys in (None, keys_for(2)):
            plain = renderer(particles, rays, keys)
            moved = renderer(sets.shifted(particles), sets.shifted_rays(rays), keys)
            assert_same(moved, plain, self.tolerance)

    @may_depart
    def test_the_picture_shows_the_particles(self) -> None:
        renderer, particles, rays = self.built(), self.particles(), self.rays()
        elsewhere = replace(particles, positions=particles.positions + particles.positions.new_tensor([0.0, 0.0, 0.3]))
        difference = renderer(elsewhere, rays, None).rgbs - renderer(particles, rays, None).rgbs
        assert difference.abs().max() > self.tolerance, "particles that move do not change the picture"

    def test_same_keys_give_the_same_picture_and_global_randomness_is_untouched(self) -> None:
        renderer = self.built().train()
        keys: RandomKeys | None
        for keys in (None, keys_for(2)):
            with global_randomness_untouched():
                first = renderer(self.particles(), self.rays(), keys)
            disturb_global_randomness()
            assert_same(renderer(self.particles(), self.rays(), keys), first)

    def test_inputs_stay_as_they_are(self) -> None:
        renderer, particles, rays = self.built(), self.particles(), self.rays()
        with unchanged(particles, rays):
            renderer(particles, rays, keys_for(2))

    def test_every_weight_and_the_features_get_a_finite_gradient(self) -> None:
        renderer = self.built().train()
        self._check_gradient(renderer, "features")
        assert_gradients(renderer)

    @may_depart
    def test_the_positions_get_a_finite_gradient(self) -> None:
        self._check_gradient(self.built().train(), "positions")

    def _check_gradient(self, renderer: AbstractRenderer, name: str) -> None:
        particles = self.particles()
        part = getattr(particles, name).requires_grad_()
        rendered = renderer(replace(particles, **{name: part}), self.rays(), keys_for(2))
        colors = rendered.rgbs if rendered.coarse_rgbs is None else [rendered.rgbs, rendered.coarse_rgbs]
        summed(colors).backward()
        assert part.grad is not None and part.grad.any(), f"no gradient of the colours reaches the {name}"
        assert_finite(part.grad, f"gradient of the {name}")

    def test_no_particle_and_one_particle(self) -> None:
        renderer, particles, rays = self.built().train(), self.particles(), self.rays()
        scenes = {
            "no valid particle": sets.only_valid(particles, 0),
            "one valid particle": sets.only_valid(particles, 1),
            "one slot": sets.first(particles, 1),
            "no slot": sets.first(particles, 0),
        }
        for name, scene in scenes.items():
            features = scene.features.detach().clone().requires_grad_()
            try:
                rendered = renderer(replace(scene, features=features), rays, keys_for(2))
            except Exception as error:
                raise AssertionError(f"{name}: {type(error).__name__}: {error}") from error
            _assert_image(rendered, (2, 12))
            renderer.zero_grad()
            summed(rendered).backward()
            gradients = {key: parameter.grad for key, parameter in renderer.named_parameters()}
            assert_finite([gradients, features.grad], f"{name}: gradient ")

    def test_no_rays_give_an_empty_picture(self) -> None:
        rays = self.rays()
        none = Rays(rays.origins[:, :0], rays.directions[:, :0])
        _assert_image(self.built()(self.particles(), none, None), (2, 0))

    def test_all_that_was_learned_is_in_the_state_dict(self) -> None:
        trained, fresh = self.built(), self.build().to(self.device, torch.float64).eval()
        fresh.load_state_dict(trained.state_dict())
        assert_same(fresh(self.particles(), self.rays(), None), trained(self.particles(), self.rays(), None))


def _assert_image(rendered: RenderedRays, shape: tuple[int, int]) -> None:
    assert rendered.rgbs.shape == (*shape, 3) and rendered.depths.shape == rendered.opacities.shape == shape
    assert rendered.coarse_rgbs is None or rendered.coarse_rgbs.shape == (*shape, 3)
    assert_finite(rendered, "rendered")
    slack = 1e-5  # a sum of float32 weights
    for name in ("rgbs", "opacities", "coarse_rgbs"):
        values = getattr(rendered, name)
        inside = values is None or bool(((values >= -slack) & (values <= 1 + slack)).all())
        assert inside, f"{name} must lie in [0, 1]"
    assert bool((rendered.depths >= 0).all()), "depths are distances along the ray and must not be negative"


def _rows(rendered: RenderedRays, some: slice) -> RenderedRays:
    coarse = rendered.coarse_rgbs
    return RenderedRays(
        rendered.rgbs[some],
        rendered.depths[some],
        rendered.opacities[some],
        None if coarse is None else coarse[some],
    )


def _columns(rendered: RenderedRays, some: slice) -> RenderedRays:
    coarse = rendered.coarse_rgbs
    return RenderedRays(
        rendered.rgbs[:, some],
        rendered.depths[:, some],
        rendered.opacities[:, some],
        None if coarse is None else coarse[:, some],
    )
