"""Predicted depth: where particles lie by it, what it learns from, and that nothing else is looked at."""

from dataclasses import replace

import pytest
import torch

from tests.encoder.test_unet import encoder as measuring_encoder
from tests.encoder.test_unet import frames
from tests.test_simulator import batch
from vpd_lightning.dynamics.persistence import PersistenceDynamics
from vpd_lightning.encoder.particles import unprojection
from vpd_lightning.encoder.unet_depth import DepthPredictingEncoder
from vpd_lightning.errors import EmptyWorkspaceError
from vpd_lightning.geometry.cameras import project, unproject
from vpd_lightning.losses.pixel import PixelLoss
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.simulator import Simulator
from vpd_lightning.types import Cameras

KEYS = RandomKeys(seed=1, step=2, sample_index=[0, 1])


def encoder(**changes):
    arguments = {
        "channels": [8, 12, 8, 12, 5],
        "num_particles": 40,
        "workspace_min": [-2, -2, -1],
        "workspace_max": [2, 2, 1],
        "initial_depth": 2.0,
        "has_driven": False,
    }
    torch.manual_seed(0)
    return DepthPredictingEncoder(**{**arguments, **changes})


def simulator(**changes):
    renderer = SplatRenderer(
        feature_dim=5, color_features=False, background_frequencies=0, hidden_dim=16,
        num_layers=2, num_candidates=8, surface_scale=0.1,
        kernel_scales=[0.5, 2.0], layer_depth=1.0, near=0.1, far=10.0, ray_chunk_size=64, candidate_backend="auto",
        facing_softness=None, has_scenery=False, num_scenery_candidates=12, elliptic_footprints=True, far_pixels=False,
        seen_through=False,
        unseen_ground=False,
        num_lights=0, num_occluders=9,
        shadow_softness=0.5,
    )  # fmt: skip
    return Simulator(
        encoder=encoder(**changes), dynamics=PersistenceDynamics(), renderer=renderer,
        location_noise=0.0, checkpoint_dynamics=False, pixel_gradient_to_motion=1.0,
    )  # fmt: skip


def head_gradient(model):
    """The gradient of the depth's own weights: no feature depends on them."""
    last = model.encoder.network.up[-1]
    return torch.cat([last.weight.grad[-1].flatten(), last.bias.grad[-1:]])


def test_depth_is_one_more_output_and_no_feature():
    model, data = encoder(), frames()

    output = model(data, KEYS, "current")

    assert model.network.up[-1].out_channels == 6 and model.feature_dim == 5
    assert output.particles.features.shape == (2, 40, 5)
    depth = output.auxiliary["predicted_depth"]
    assert depth.shape == (2, 2, 8, 8) and (depth > 0).all()
    # Particles lie where the depth of their own pixel says, and carry the features of that pixel.
    features, _ = model.features_and_depth(data.rgb.float() / 255)
    for member, view in ((0, 0), (1, 1)):
        pixels, z = project(output.particles.positions[member], data.cameras[member, view])
        x, y = pixels.floor().long().unbind(-1)
        here = ((pixels.frac() - 0.5).abs() < 1e-3).all(-1) & (x >= 0) & (x < 8) & (y >= 0) & (y < 8)
        x, y = x.clamp(0, 7), y.clamp(0, 7)
        here &= (z - depth[member, view, y, x]).abs() < 1e-5
        assert int(here.sum()) > 10
        own = features[member, view, y, x]
        assert torch.allclose(output.particles.features[member][here], own[here], atol=1e-6)


@pytest.mark.parametrize("initial_depth", [0.05, 0.69, 2.0, 13.0, 200.0])
def test_depth_starts_at_the_given_number_of_metres(initial_depth):
    model = encoder(initial_depth=initial_depth)
    with torch.no_grad():
        model.network.up[-1].weight[-1] = 0.0  # what the picture adds

    _, depth = model.features_and_depth(torch.rand(1, 1, 8, 8, 3))

    assert torch.allclose(depth, torch.tensor(initial_depth), rtol=1e-5)


def test_true_depth_in_place_of_the_predicted_one_gives_the_standard_particles(monkeypatch):
    standard, model, data = measuring_encoder(), encoder(), frames()
    data.depth[:] = 1.7 + 0.5 * torch.rand(data.depth.shape, generator=torch.Generator().manual_seed(4))
    data.depth[0, 0, 0, :3] = torch.tensor([0.0, float("nan"), float("inf")])  # not measured
    data.depth[0, 1, 2] = 9.0  # outside the workspace
    every = standard.pixel_features(data.rgb.float() / 255)
    monkeypatch.setattr(model, "features_and_depth", lambda rgb: (every, data.depth))

    ours = model(data, KEYS, "current").particles
    theirs = standard(data, KEYS, "current").particles

    for name in ("positions", "features", "mask", "colors"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name)), name


@pytest.mark.parametrize("hidden", [0.0, float("nan"), 123.0])
def test_measured_depth_is_never_looked_at(hidden):
    model, data = encoder(), frames()
    expected = model(data, KEYS, "current")

    output = model(replace(data, depth=torch.full_like(data.depth, hidden)), KEYS, "current")

    for name in ("positions", "features", "mask", "colors"):
        assert torch.equal(getattr(output.particles, name), getattr(expected.particles, name)), name
    assert torch.equal(output.auxiliary["predicted_depth"], expected.auxiliary["predicted_depth"])


def test_prediction_without_any_measured_depth_is_finite():
    model, data = simulator(), batch(1)
    frames_of_one = data.context[0]
    nothing = torch.full_like(frames_of_one.depth, float("nan"))
    cameras = frames_of_one.cameras
    steps = Cameras(cameras.intrinsics[:1].repeat(2, 1, 1, 1), cameras.cam_to_world[:1].repeat(2, 1, 1, 1), 8, 8)

    pictures = model.predict_frames(replace(frames_of_one, depth=nothing), steps)

    assert pictures.shape == (2, 2, 8, 8, 3) and torch.isfinite(pictures).all()


def test_rendering_loss_alone_teaches_depth_through_positions(monkeypatch):
    data = batch()
    model = simulator()
    PixelLoss(weight=1.0, coarse_weight=1.0)(model(data), data).backward()
    assert torch.isfinite(head_gradient(model)).all() and head_gradient(model).abs().max() > 1e-8

    # Positions carry it: without their gradient, nothing is left.
    model = simulator()
    monkeypatch.setattr(unprojection, "unproject", lambda depth, cameras: unproject(depth.detach(), cameras))
    PixelLoss(weight=1.0, coarse_weight=1.0)(model(data), data).backward()
    assert not head_gradient(model).any()


def test_an_empty_workspace_says_where_the_depth_should_start():
    with pytest.raises(EmptyWorkspaceError, match=r"workspace(.|\n)*initial_depth"):
        encoder(initial_depth=20.0)(frames(), KEYS, "current")


@pytest.mark.parametrize("initial_depth", [0.0, -1.0, float("inf"), float("nan")])
def test_impossible_depths_to_start_from_are_refused(initial_depth):
    with pytest.raises(ValueError, match="initial_depth"):
        encoder(initial_depth=initial_depth)
