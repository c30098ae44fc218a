"""What an encoder observes of later frames, and how the simulator hands it on."""

from dataclasses import replace

import pytest
import torch

from vpd_lightning.dynamics.persistence import PersistenceDynamics
from vpd_lightning.encoder.particles.wide_surface_background import WideSurfaceBackground
from vpd_lightning.encoder.unet import UNetEncoder
from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.motion import MotionLoss
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.simulator import Simulator
from vpd_lightning.testing.scenes import WORKSPACE_MAX, WORKSPACE_MIN, ball_frames, keys_for, video_batch
from vpd_lightning.types import Cameras, RGBDFrames

NUM_PARTICLES = 60


def encoder(has_background=True):
    background = WideSurfaceBackground(
        max_slope=0.15,
        max_turn_degrees=20.0,
        min_width=0.4,
        tolerance=0.5,
        memory_frames=16,
        noise_floor=None,
    )
    return UNetEncoder(
        channels=[6, 8, 6, 8, 5],
        num_particles=NUM_PARTICLES,
        workspace_min=WORKSPACE_MIN,
        workspace_max=WORKSPACE_MAX,
        moving_fraction=0.5 if has_background else None,
        background=background if has_background else None,
        use_normals=True,
        color_features=False,
        same_pixels=False,
        has_scenery=False,
        has_driven=False,
    ).double()


def observed(frames, model=None, purpose="0"):
    return (model or encoder()).observe(frames, keys_for(len(frames.depth)), purpose)


def test_points_lie_on_the_ball_with_the_colours_of_their_pixels():
    found = observed(ball_frames(2, time=1.0))

    assert found["positions"].shape == found["colors"].shape == (2, NUM_PARTICLES // 4, 3)
    for member, start in enumerate([(0.05, -0.05, 0.3), (-0.1, 0.1, 0.25)]):
        center = torch.tensor(start).double() + torch.tensor([0.03, 0.02, -0.02]).double()
        points, mask = found["positions"][member], found["mask"][member]
        assert mask.sum() > 5
        assert ((points[mask] - center).norm(dim=-1) - 0.15).abs().max() < 1e-6  # the ball's radius
        # its colour is 0.5 + place, in 255 steps
        assert (found["colors"][member][mask] - (0.5 + points[mask]).clamp(0, 1)).abs().max() < 0.003
    assert not found["positions"].requires_grad


@pytest.mark.parametrize("depth", [0.0, float("nan"), float("inf")])
def test_frames_without_depth_or_with_nothing_that_moves_are_empty_and_finite(depth):
    frames = ball_frames(2)
    empty = replace(frames, depth=torch.full_like(frames.depth, depth))
    for seen in (observed(empty), observed(ball_frames(2, has_ball=False))):
        assert not seen["mask"].any()
        assert (seen["positions"] == 0).all() and (seen["colors"] == 0).all()


def test_the_same_keys_draw_the_same_points_and_purposes_draw_others():
    frames, model = ball_frames(2), encoder()
    # as many pixels of the ball as are drawn would be drawn in another order only
    one, again, other = (observed(frames, model, purpose) for purpose in ("0", "0", "1"))

    assert all(torch.equal(one[name], again[name]) for name in one)
    assert not torch.equal(one["positions"], other["positions"])


def test_a_batch_is_its_members():
    frames = ball_frames(2)
    both = observed(frames)
    for member in range(2):
        keys = replace(keys_for(2), sample_index=[member])
        alone = encoder().observe(frames[member : member + 1], keys, "0")
        for name, value in alone.items():
            assert torch.equal(value[0], both[name][member]), name


def test_without_a_background_nothing_is_observed():
    assert observed(ball_frames(2), encoder(has_background=False)) == {}


def with_future(batch, num_steps):
    """The batch with images of the steps to predict."""
    frames = [ball_frames(len(batch.rgbs), 2.0 + step) for step in range(num_steps)]
    first = frames[0].cameras
    stacked = [torch.stack([values] * num_steps, dim=1) for values in (first.intrinsics, first.cam_to_world)]
    future = RGBDFrames(
        torch.stack([frame.rgb for frame in frames], dim=1),
        torch.stack([frame.depth for frame in frames], dim=1),
        Cameras(*stacked, first.height, first.width),
    )
    return replace(batch, future=future), frames


def simulator(has_background=True):
    renderer = SplatRenderer(
        feature_dim=5, color_features=False, background_frequencies=0, hidden_dim=16,
        num_layers=2, num_candidates=8, surface_scale=0.1, kernel_scales=[0.5, 2.0],
        layer_depth=1.0, near=0.1, far=10.0, ray_chunk_size=64, candidate_backend="auto",
        facing_softness=None, has_scenery=False, num_scenery_candidates=12, elliptic_footprints=True, far_pixels=False,
        seen_through=False,
        unseen_ground=False,
        num_lights=0, num_occluders=9,
        shadow_softness=0.5,
    )  # fmt: skip
    return Simulator(
        encoder=encoder(has_background), dynamics=PersistenceDynamics(), renderer=renderer, location_noise=0.0,
        checkpoint_dynamics=False,
        pixel_gradient_to_motion=1.0,
    ).double()  # fmt: skip


def motion_loss():
    return MotionLoss(weight=1.0, scales=[0.1, 0.2], color_scale=0.15, num_particles=64)


def test_the_simulator_observes_every_future_frame_in_its_order():
    batch, frames = with_future(video_batch(2, num_steps=3), 3)
    model = simulator()
    auxiliary = model(batch).auxiliary

    for step, frame in enumerate(frames):
        expected = model.encoder.observe(frame, batch.keys, str(step))
        for name, value in expected.items():
            assert torch.equal(auxiliary[f"future_{name}"][:, step], value), (name, step)
    value = motion_loss()(model(batch), batch)
    assert torch.isfinite(value)


def test_without_future_frames_or_a_background_the_loss_says_what_to_set():
    batch, _ = with_future(video_batch(2), 2)
    for model, given in ((simulator(), video_batch(2)), (simulator(has_background=False), batch)):
        output = model(given)
        assert not any(name.startswith("future_") for name in output.auxiliary)
        with pytest.raises(ConfigError, match="data.load_future=true"):
            motion_loss()(output, given)
