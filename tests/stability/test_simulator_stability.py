"""Encoder, dynamics and renderer together: two hard frames in, finite pictures and finite gradients out."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.stability.hard_scenes import Mode, is_finite
from tests.stability.stages import options, stage
from vpd_lightning.losses.pixel import PixelLoss
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.simulator import Scene, Simulator
from vpd_lightning.testing.scenes import ring_cameras, video_batch
from vpd_lightning.types import Particles, SimulatorOutput, VideoBatch

READS_NORMALS = ("inertial",)
# The paper's dynamics before every renderer, and every other dynamics before one of them.
PAIRS = [("hierarchical_gnn", name) for name in options("renderer")] + [
    (name, "surface") for name in options("dynamics") if name not in ("hierarchical_gnn", *READS_NORMALS)
]


@pytest.fixture(params=PAIRS, ids="-".join)
def pair(request: pytest.FixtureRequest) -> tuple[str, str]:
    return request.param


def simulator(
    pair: tuple[str, str], mode: Mode, device: torch.device, scale: float = 1.0, encoder: str = "unet", **changes
) -> Simulator:
    return Simulator(
        encoder=stage("encoder", encoder, mode, device, scale, **changes),
        dynamics=stage("dynamics", pair[0], mode, device, scale),
        renderer=stage("renderer", pair[1], mode, device, scale),
        location_noise=0.0,
        checkpoint_dynamics=False,
        pixel_gradient_to_motion=1.0,
    ).train()


def batch_for(mode: Mode, device: torch.device, scale: float = 1.0, shift: float = 0.0) -> VideoBatch:
    batch = video_batch(num_steps=2, num_rays=6)
    pose = batch.context.cameras.cam_to_world.clone()
    pose[..., :3, 3] = pose[..., :3, 3] * scale + shift
    context = replace(
        batch.context,
        depth=batch.context.depth * scale,
        cameras=replace(batch.context.cameras, cam_to_world=pose),
    )
    rays = replace(batch.rays, origins=batch.rays.origins * scale + shift)
    return replace(batch, context=context, rays=rays).to(device, mode.dtype)


def trained_one_step(model: Simulator, batch: VideoBatch, mode: Mode, device: torch.device) -> SimulatorOutput:
    """Run forward and backward, and check that everything that comes out is finite."""
    with mode.context(device):
        output = model(batch)
        loss = PixelLoss(weight=1.0, coarse_weight=0.1)(output, batch)
    weights = {name: p for name, p in model.named_parameters() if p.requires_grad}
    gradients = torch.autograd.grad(loss, list(weights.values()), materialize_grads=True)
    assert is_finite(loss, output.rendered.rgbs, output.rendered.depths, *gradients)
    assert all(is_finite(state.positions, state.features) for state in output.states)
    return output


def with_depth(batch: VideoBatch, depth: Tensor) -> VideoBatch:
    return replace(batch, context=replace(batch.context, depth=depth))


@pytest.mark.parametrize("missing", [0.0, torch.nan, torch.inf])
def test_training_on_frames_with_missing_depth(pair: tuple[str, str], missing: float, mode: Mode, device: torch.device):
    batch = batch_for(mode, device)
    depth = batch.context.depth.clone()
    depth[..., ::3] = missing

    trained_one_step(simulator(pair, mode, device), with_depth(batch, depth), mode, device)


def test_training_on_a_single_particle(pair: tuple[str, str], mode: Mode, device: torch.device):
    batch = batch_for(mode, device)
    depth = torch.zeros_like(batch.context.depth)
    depth[:, :, 0, 9, 8] = batch.context.depth[:, :, 0, 9, 8]

    output = trained_one_step(simulator(pair, mode, device), with_depth(batch, depth), mode, device)

    assert output.states[-1].mask.sum(dim=1).tolist() == [1, 1]


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_training_in_worlds_of_any_size(pair: tuple[str, str], scale: float, mode: Mode, device: torch.device):
    trained_one_step(simulator(pair, mode, device, scale), batch_for(mode, device, scale), mode, device)


@pytest.mark.parametrize("shift", [1e3, 1e6])
def test_training_far_from_the_origin(pair: tuple[str, str], shift: float, mode: Mode, device: torch.device):
    box = {"workspace_min": [shift - 0.7] * 3, "workspace_max": [shift + 0.7] * 3}

    trained_one_step(simulator(pair, mode, device, **box), batch_for(mode, device, shift=shift), mode, device)


@pytest.mark.parametrize("value", [0, 255])
def test_training_on_images_of_one_colour(pair: tuple[str, str], value: int, mode: Mode, device: torch.device):
    batch = batch_for(mode, device)
    rgb = torch.full_like(batch.context.rgb, value)
    targets = torch.full_like(batch.rgbs, value / 255)

    trained_one_step(
        simulator(pair, mode, device),
        replace(batch, context=replace(batch.context, rgb=rgb), rgbs=targets),
        mode,
        device,
    )


def test_autocast_and_float64_agree_with_float32(pair: tuple[str, str], device: torch.device):
    modes = {
        "float32": Mode("float32", torch.float32),
        "bf16": Mode("bf16", torch.float32, is_autocast=True),
        "float64": Mode("float64", torch.float64),
    }
    pictures, places = {}, {}
    weights = simulator(pair, modes["float32"], device).state_dict()
    for name, mode in modes.items():
        model = simulator(pair, mode, device)
        model.load_state_dict(weights)
        output = trained_one_step(model.eval(), batch_for(modes["float32"], device).to(mode.dtype), mode, device)
        pictures[name], places[name] = output.rendered.rgbs.double(), output.states[-1].positions.double()

    # float32: rounding, through three networks. bfloat16: factors of 8 bits in about twenty layers; places move by a
    # small scale times tanh, so they are as good as that scale times the same share.
    torch.testing.assert_close(pictures["float32"], pictures["float64"], rtol=0, atol=1e-3)
    torch.testing.assert_close(places["float32"], places["float64"], rtol=0, atol=1e-5)
    torch.testing.assert_close(pictures["bf16"], pictures["float64"], rtol=0, atol=0.1)
    torch.testing.assert_close(places["bf16"], places["float64"], rtol=0, atol=0.01)


@pytest.mark.parametrize("renderer", options("renderer"))
def test_inertial_dynamics_from_frames(renderer: str, mode: Mode, device: torch.device):
    model = simulator(("inertial", renderer), mode, device, encoder="unet", use_normals=True)

    trained_one_step(model, batch_for(mode, device), mode, device)


def test_a_scene_that_was_emptied_rolls_out_and_renders(pair: tuple[str, str], mode: Mode, device: torch.device):
    model = simulator(pair, mode, device)
    nothing = Particles(
        torch.zeros(1, 0, 3, device=device, dtype=mode.dtype), torch.zeros(1, 0, 6, device=device, dtype=mode.dtype)
    )

    with mode.context(device):
        states = model.rollout(Scene(nothing, nothing), 2, RandomKeys.fixed(1))
        frames = model.render(states, ring_cameras(1, 8).to(device, mode.dtype))

    assert frames.shape == (2, 1, 8, 8, 3) and is_finite(frames)
