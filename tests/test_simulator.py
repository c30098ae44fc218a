"""Encode, roll out, render: the parts put together, on a hand-made scene."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.encoder.test_unet import encoder, looking_down
from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.dynamics.persistence import PersistenceDynamics
from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.losses.pixel import PixelLoss
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.simulator import Simulator
from vpd_lightning.types import Cameras, Rays, RenderedRays, RGBDFrames, SimulatorOutput, VideoBatch

NUM_STEPS = 3


class Drift(AbstractDynamics):
    """Moves everything by a learned step, a little differently at each rollout step."""

    def __init__(self):
        super().__init__()
        self.step = torch.nn.Parameter(torch.tensor([0.01, 0.0, 0.02]))

    def forward(self, previous, current, memory, keys, rollout_step):
        jitter = torch.stack([torch.rand(3, generator=g) for g in keys.generators(f"drift/{rollout_step}")])
        return replace(current, positions=current.positions + self.step * (1 + jitter[:, None])), memory


def renderer():
    return SplatRenderer(
        feature_dim=5, color_features=False, background_frequencies=0, hidden_dim=16,
        num_layers=2, num_candidates=8, surface_scale=0.1,
        kernel_scales=[0.5, 2.0], layer_depth=1.0, near=0.1, far=10.0, ray_chunk_size=64, candidate_backend="auto",
        facing_softness=None, has_scenery=False, num_scenery_candidates=12, elliptic_footprints=True, far_pixels=False,
        seen_through=False,
        unseen_ground=False,
        num_lights=0, num_occluders=9,
        shadow_softness=0.5,
    )  # fmt: skip


def simulator(dynamics=None, **changes):
    settings = {"location_noise": 0.0, "checkpoint_dynamics": False, "pixel_gradient_to_motion": 1.0, **changes}
    return Simulator(encoder=encoder(), dynamics=dynamics or PersistenceDynamics(), renderer=renderer(), **settings)


def batch(size=2, num_rays=6, seed=0, first_index=0):
    generator = torch.Generator().manual_seed(seed)
    cameras = looking_down()
    pose = Cameras(cameras.intrinsics.expand(size, 2, -1, 3, 3), cameras.cam_to_world.expand(size, 2, -1, 4, 4), 8, 8)
    rgb = torch.randint(0, 256, (size, 2, 2, 8, 8, 3), generator=generator, dtype=torch.uint8)
    depth = 1.8 + 0.2 * torch.rand(size, 2, 2, 8, 8, generator=generator)
    rays = pixel_rays(cameras)
    chosen = torch.randint(0, 128, (size, NUM_STEPS, num_rays), generator=generator)
    return VideoBatch(
        context=RGBDFrames(rgb, depth, pose),
        rays=Rays(rays.origins.reshape(-1, 3)[chosen], rays.directions.reshape(-1, 3)[chosen]),
        rgbs=torch.rand(size, NUM_STEPS, num_rays, 3, generator=generator),
        keys=RandomKeys(seed=7, step=3, sample_index=list(range(first_index, first_index + size))),
        clips=[f"clip{i}" for i in range(size)],
    )


def member(data, index):
    return VideoBatch(
        context=data.context[index : index + 1],
        rays=Rays(data.rays.origins[index : index + 1], data.rays.directions[index : index + 1]),
        rgbs=data.rgbs[index : index + 1],
        keys=replace(data.keys, sample_index=[data.keys.sample_index[index]]),
        clips=[data.clips[index]],
    )


def test_output_has_a_colour_for_every_ray_of_every_step():
    output = simulator()(batch())

    assert output.rendered.rgbs.shape == (2, NUM_STEPS, 6, 3)
    assert len(output.states) == NUM_STEPS


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_batch_equals_its_members(noise):
    model = simulator(Drift(), location_noise=noise)
    data = batch()

    together = model(data).rendered.rgbs

    for index in range(2):
        assert torch.allclose(model(member(data, index)).rendered.rgbs, together[index : index + 1], atol=1e-6)


def test_rays_of_a_step_see_the_particles_of_that_step():
    model = simulator(Drift()).eval()
    data = batch()
    states = model(data).states

    for step in (0, NUM_STEPS - 1):
        alone = model.renderer(states[step], Rays(data.rays.origins[:, step], data.rays.directions[:, step]), None)
        assert torch.allclose(model(data).rendered.rgbs[:, step], alone.rgbs, atol=1e-6)


class Remembers(torch.nn.Module):
    """Draws black, and keeps the particles that it was given."""

    def forward(self, particles, rays, keys):
        self.particles = particles
        return RenderedRays(torch.zeros_like(rays.origins), *2 * [rays.origins[..., 0]])


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("has_future", [True, False])
def test_shadows_of_a_training_are_those_of_what_is_seen_later(training, has_future, monkeypatch):
    model, data = simulator(Drift()).train(training), batch()
    model.renderer = Remembers()

    def observe(frames, keys, purpose):
        return {"positions": frames.depth[:, 0, 0, :3, None].expand(-1, -1, 3), "mask": frames.depth[:, 0, 0, :3] > 1.9}

    monkeypatch.setattr(model.encoder, "observe", observe)
    later = torch.linspace(1.8, 2.0, 2 * NUM_STEPS * 2 * 64).reshape(2, NUM_STEPS, 2, 8, 8)
    cameras = Cameras(*(part.expand(2, NUM_STEPS, 2, -1, -1) for part in pose_parts()), 8, 8)
    future = RGBDFrames(torch.zeros(*later.shape, 3, dtype=torch.uint8), later, cameras)

    model(replace(data, future=future) if has_future else data)

    occluders = model.renderer.particles.occluders
    if not (training and has_future):
        assert occluders is None
        return
    for row, (number, step) in enumerate(itertools.product(range(2), range(NUM_STEPS))):
        assert torch.equal(occluders.positions[row, :, 0], later[number, step, 0, 0, :3])
        assert torch.equal(occluders.mask[row], later[number, step, 0, 0, :3] > 1.9)


def pose_parts():
    cameras = looking_down()
    return cameras.intrinsics, cameras.cam_to_world


def test_checkpointed_dynamics_gives_the_same_gradients():
    gradients = []
    for checkpointed in (False, True):
        torch.manual_seed(0)
        model = simulator(Drift(), checkpoint_dynamics=checkpointed, location_noise=0.01)
        model(batch()).rendered.rgbs.square().sum().backward()
        gradients.append([parameter.grad.clone() for parameter in model.parameters()])

    for plain, checkpointed in zip(*gradients, strict=True):
        assert torch.equal(plain, checkpointed)


def test_noise_is_for_training_only():
    model = simulator(location_noise=0.1)

    noisy = model(batch()).states[-1].positions
    quiet = model.eval()(batch()).states[-1].positions

    assert (noisy - quiet).abs().max() > 0.05
    assert torch.equal(quiet, model(batch()).states[0].positions)


class Noted(AbstractDynamics):
    """Stands still; keeps the pairs of frames that it is given."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def forward(self, previous, current, memory, keys, rollout_step):
        self.seen.append((previous.positions, current.positions))
        return current, memory


def test_what_a_step_saw_as_current_with_its_noise_the_next_one_sees_as_previous():
    model = simulator(Noted(), location_noise=0.1)
    model(batch())
    seen = model.dynamics.seen

    assert len(seen) == NUM_STEPS
    for (_, current), (later_previous, later_current) in itertools.pairwise(seen):
        # What stands still seems to move by the noise of one step; that of two would be 0.14.
        assert 0.08 < float((later_current - later_previous).std()) < 0.12
        assert torch.equal(later_previous, current)


def test_the_python_face_encodes_rolls_out_and_renders():
    model, data, cameras = simulator(Drift()), batch(), looking_down()

    scene = model.encode(data.context.rgb[0], data.context.depth[0], cameras)
    states = model.rollout(scene, num_steps=2)
    frames = model.render(states, cameras)
    maps = model.render_maps(states, cameras)

    assert frames.shape == (2, 2, 8, 8, 3) and (frames >= 0).all() and (frames <= 1).all()
    assert maps.depths.shape == (2, 2, 8, 8) and maps.opacities.shape == (2, 2, 8, 8)
    assert torch.equal(frames, model.render(model.rollout(model.encode(
        data.context.rgb[0].float() / 255, data.context.depth[0].double(), cameras), 2), cameras))  # fmt: skip


def test_numpy_arrays_are_encoded_as_tensors_are():
    model, context, cameras = simulator(Drift()), batch().context, looking_down()
    matrices = [part.double().numpy() for part in (cameras.intrinsics, cameras.cam_to_world)]

    found = model.encode(
        context.rgb[0].numpy(),
        context.depth[0].double().numpy(),
        Cameras.from_arrays(*matrices, cameras.height, cameras.width),
    )

    expected = model.encode(context.rgb[0], context.depth[0], cameras)
    assert torch.equal(found.current.positions, expected.current.positions)
    assert torch.equal(found.current.features, expected.current.features)


def test_matrices_of_the_wrong_shape_and_depth_in_millimetres_are_refused():
    with pytest.raises(ValueError, match=r"cam_to_world \(view, 4, 4\), got"):
        Cameras.from_arrays(np.eye(3)[None], np.eye(4), 8, 8)
    context = batch().context
    with pytest.raises(ValueError, match="metres"):
        simulator().encode(context.rgb[0], (context.depth[0] * 1000).short(), looking_down())


def test_frames_of_the_wrong_shape_are_refused():
    data = batch()
    with pytest.raises(ValueError, match="view, height, width"):
        simulator().encode(data.context.rgb[0, :1], data.context.depth[0, :1], looking_down())


def test_negative_noise_is_refused():
    with pytest.raises(ValueError, match="location_noise"):
        simulator(location_noise=-1.0)


def test_pixel_loss_is_the_mean_square_over_steps_and_rays_plus_the_coarse_tier():
    data = batch()
    exact = RenderedRays(data.rgbs, torch.zeros(2, NUM_STEPS, 6), torch.ones(2, NUM_STEPS, 6), data.rgbs + 0.5)

    loss = PixelLoss(weight=1.0, coarse_weight=0.2)(SimulatorOutput(exact, []), data)

    assert torch.allclose(loss, torch.tensor(0.2 * 0.25))
