"""What the simulator relies on in an encoder."""

from dataclasses import replace

import torch
from torch import Tensor

from vpd_lightning.encoder.base import AbstractEncoder, EncoderOutput
from vpd_lightning.errors import VPDError
from vpd_lightning.testing.contract import (
    Contract,
    assert_finite,
    assert_gradients,
    assert_precision,
    assert_same,
    disturb_global_randomness,
    global_randomness_untouched,
    may_depart,
    summed,
    unchanged,
)
from vpd_lightning.testing.scenes import FEATURE_DIM, ball_frames, keys_for
from vpd_lightning.types import Particles, RGBDFrames


class EncoderContract(Contract):
    """Subclass as ``class TestMine(EncoderContract)`` and return the encoder from ``build``.

    Build it for ``NUM_VIEWS`` images of ``IMAGE_SIZE`` pixels a side, the box ``WORKSPACE_MIN`` to ``WORKSPACE_MAX``
    (metres) and particles of ``feature_dim`` numbers. A background model, where there is one, is fitted to the empty
    floor before the checks, as training does.
    """

    feature_dim: int = FEATURE_DIM

    def build(self) -> AbstractEncoder:
        """Return a new encoder at a small size; it need not be fitted."""
        return super().build()

    def built(self, dtype: torch.dtype = torch.float64) -> AbstractEncoder:
        """Return an encoder in evaluation mode, its background model fitted."""
        encoder = super().built(dtype)
        if encoder.background is not None and encoder.background.needs_fit:
            still = ball_frames(1, has_ball=False).to(self.device)[0]
            encoder.background.fit(still.rgb, still.depth.to(dtype), still.cameras.to(dtype))
        return encoder

    def frames(self, batch_size: int = 2) -> RGBDFrames:
        """Return the images of the checks; override for another scene."""
        return ball_frames(batch_size, time=1.0).to(self.device)

    def test_particles_have_the_promised_shapes_and_precision(self) -> None:
        for dtype in (torch.float32, torch.float64):
            encoder = self.built(dtype)
            output = encoder(self.frames().to(dtype), keys_for(2), "current")
            assert isinstance(output, EncoderOutput)
            particles, count = output.particles, output.particles.num_particles
            assert particles.positions.shape == (2, count, 3)
            assert particles.features.shape == (2, count, self.feature_dim)
            assert particles.mask.shape == (2, count) and particles.mask.any(dim=1).all()
            assert_precision(output, dtype)
            assert_finite(output, "output")
            assert all(isinstance(value, Tensor) for value in output.auxiliary.values())
            other = encoder(ball_frames(2, time=3.0).to(self.device).to(dtype), keys_for(2), "current")
            assert other.particles.num_particles == count, "the number of slots must not depend on the images"

    @may_depart
    def test_particles_lie_on_what_was_measured(self) -> None:
        from vpd_lightning.geometry.cameras import unproject

        frames = self.frames(1)
        holed = frames.depth.clone()
        holed[..., ::2] = 0.0  # half of the image is not measured: no particle may come from there
        for depth in (frames.depth, holed):
            particles = self.built()(replace(frames, depth=depth), keys_for(1), "current").particles
            surface = unproject(depth, frames.cameras)[depth > 0]
            gap = (particles.positions[particles.mask][:, None] - surface).norm(dim=-1).amin(dim=1)
            assert gap.max() < 0.05, f"a particle lies {gap.max().item():.2f} m from every measured point"

    def test_a_batch_equals_its_members(self) -> None:
        encoder, frames = self.built(), self.frames(3)
        together = encoder(frames, keys_for(3), "current")
        for index in range(3):
            some = slice(index, index + 1)
            alone = encoder(frames[some], replace(keys_for(3), sample_index=[index]), "current")
            assert_same(_valid(alone.particles), _valid(_member(together.particles, some)), self.tolerance)

    def test_bytes_and_fractions_are_the_same_colours(self) -> None:
        encoder, frames = self.built(), self.frames()
        fractions = replace(frames, rgb=frames.rgb.to(torch.float64) / 255)
        first, second = (encoder(one, keys_for(2), "current").particles for one in (frames, fractions))
        assert_same(_valid(first), _valid(second), self.tolerance)

    def test_missing_depth_is_masked_however_it_is_written(self) -> None:
        encoder, frames = self.built().train(), self.frames()
        results = []
        for nothing in (0.0, float("nan"), float("inf")):
            depth = frames.depth.clone()
            depth[:, :, ::2] = nothing
            output = encoder(replace(frames, depth=depth), keys_for(2), "current")
            assert_finite(output, f"depth {nothing}: output")
            encoder.zero_grad()
            summed(_valid(output.particles)).backward()
            assert_finite({name: p.grad for name, p in encoder.named_parameters()}, f"depth {nothing}: gradient of ")
            results.append(_valid(output.particles))
        assert_same(results[1], results[0], self.tolerance)
        assert_same(results[2], results[0], self.tolerance)

    def test_one_measured_pixel_is_enough(self) -> None:
        encoder, frames = self.built(), self.frames()
        depth = torch.zeros_like(frames.depth)
        middle = frames.depth.shape[-1] // 2
        depth[:, 0, middle, middle] = frames.depth[:, 0, middle, middle]
        one = encoder(replace(frames, depth=depth), keys_for(2), "current").particles
        assert (one.mask.sum(dim=1) >= 1).all()
        assert_finite(one, "one measured pixel: particles")

    @may_depart
    def test_without_a_measured_pixel_there_is_nothing(self) -> None:
        encoder, frames = self.built(), self.frames()
        try:
            none = encoder(replace(frames, depth=torch.zeros_like(frames.depth)), keys_for(2), "current").particles
        except VPDError:
            return  # an error that a person can act on is as good as an empty scene
        assert not none.mask.any(), "without any measurement there can be no particles"
        assert_finite(none, "no measured pixel: particles")

    def test_same_keys_give_the_same_particles_and_global_randomness_is_untouched(self) -> None:
        encoder = self.built().train()
        for purpose in ("previous", "current"):
            with global_randomness_untouched():
                first = encoder(self.frames(), keys_for(2), purpose)
            disturb_global_randomness()
            assert_same(encoder(self.frames(), keys_for(2), purpose), first)

    def test_inputs_stay_as_they_are(self) -> None:
        encoder, frames = self.built(), self.frames()
        with unchanged(frames):
            encoder(frames, keys_for(2), "current")

    def test_every_weight_gets_a_finite_gradient(self) -> None:
        encoder = self.built().train()
        output = encoder(self.frames(), keys_for(2), "current")
        summed([_valid(output.particles), output.auxiliary]).backward()
        assert_gradients(encoder)

    def test_all_that_was_learned_is_in_the_state_dict(self) -> None:
        trained, fresh = self.built(), self.build().to(self.device, torch.float64).eval()
        fresh.load_state_dict(trained.state_dict())
        assert_same(fresh(self.frames(), keys_for(2), "current"), trained(self.frames(), keys_for(2), "current"))


def _valid(particles: Particles) -> list[Tensor | None]:
    """Return all parts of the particles with zeros in padding, whose content means nothing."""
    parts = (particles.positions, particles.features, particles.colors, particles.normals)
    mask = particles.mask[..., None]
    moving = None if particles.moving is None else particles.moving & particles.mask
    return [*(None if part is None else torch.where(mask, part, 0.0) for part in parts), particles.mask, moving]


def _member(particles: Particles, some: slice) -> Particles:
    from vpd_lightning.testing.particle_sets import mapped

    return mapped(particles, lambda values: values[some])
