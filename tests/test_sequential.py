"""Both trainings of the ablation: what is compared, what learns, what is handed over, and that it is used as ever."""

from dataclasses import replace

import pytest
import torch

from tests.encoder.test_unet import encoder
from tests.renderer.small_renderer import SMALL
from tests.test_simulator import NUM_STEPS, Drift, batch, member, renderer
from vpd_lightning.config import build_simulator, compose, pretraining_config
from vpd_lightning.dynamics.persistence import PersistenceDynamics
from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.pixel import PixelLoss
from vpd_lightning.losses.point_features import PointFeatureLoss
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.point_nerf import PointNeRFRenderer
from vpd_lightning.renderer.surface import SurfaceRenderer
from vpd_lightning.sequential import AutoEncoder, SequentialSimulator, narrowest_mass
from vpd_lightning.simulator import Simulator
from vpd_lightning.training.step_factors import StepFactorsAdam
from vpd_lightning.types import Cameras, Particles, Rays, RGBDFrames, SimulatorOutput

WORKSPACE = {"workspace_min": [-1.0, -0.5, -0.1], "workspace_max": [1.0, 1.4, 1.4]}
LOSS = PointFeatureLoss(weight=1.0, min_mass=0.1)


def point_nerf(**changes):
    return PointNeRFRenderer(**(SMALL | {"feature_dim": 5} | changes))


def surface(**changes):
    settings = {name: SMALL[name] for name in ("num_neighbors", "kernel_radii", "kernel_bandwidths", "near", "far")}
    settings |= {name: SMALL[name] for name in ("net_depth", "net_width", "skip_layer", "net_width_condition")}
    settings |= {"feature_dim": 5, "num_samples": 6, "num_uniform_samples": 2, "num_candidates": 8, "footprint": None}
    settings |= {"hint_spread": 1.5, "view_degree": 2, "density_activation": "softplus", "background_width": 4}
    settings |= {"kernel_normalization": None, "normalization_epsilon": 1e-6, "feature_network": None}
    settings |= {"ray_chunk_size": 1000, "checkpoint_chunks": False, "candidate_backend": "auto"}
    return SurfaceRenderer(**(settings | changes))


def stages(seed=0, **changes):
    torch.manual_seed(seed)
    settings = {"encoder": encoder(), "dynamics": PersistenceDynamics(), "renderer": point_nerf()}
    return {**settings, "location_noise": 0.0, "checkpoint_dynamics": False, **changes}


def sequential(**changes):
    return SequentialSimulator(**stages(**({"num_points": 40} | WORKSPACE | changes)))


def frames_of(size=2, seed=5):
    """Frames of the predicted steps: other pictures and depths at every step."""
    data = batch(size)
    generator = torch.Generator().manual_seed(seed)
    cameras = data.context.cameras
    shape = (size, NUM_STEPS, 2, 8, 8)
    return RGBDFrames(
        torch.randint(0, 256, (*shape, 3), generator=generator, dtype=torch.uint8),
        1.8 + 0.2 * torch.rand(shape, generator=generator),
        Cameras(
            cameras.intrinsics[:, :1].expand(size, NUM_STEPS, 2, 3, 3),
            cameras.cam_to_world[:, :1].expand(size, NUM_STEPS, 2, 4, 4),
            8,
            8,
        ),
    )


def training_batch(size=2, **changes):
    return replace(batch(size, **changes), future=frames_of(size))


def cloud(count=30, seed=1):
    generator = torch.Generator().manual_seed(seed)
    draw = {"generator": generator, "dtype": torch.float64}
    return Particles(torch.rand(1, count, 3, **draw), torch.rand(1, count, 5, **draw))


def shuffled(particles):
    order = torch.randperm(particles.num_particles, generator=torch.Generator().manual_seed(3))
    return Particles(particles.positions[:, order], particles.features[:, order])


def compared(model, predicted, target):
    """The loss between two clouds at the model's points."""
    points = model.draw_points(RandomKeys.fixed(1), 0).double()
    features = [model.renderer.point_features(particles, points)[:, None] for particles in (predicted, target)]
    mass = narrowest_mass(model.renderer, target, points)[:, None]
    output = SimulatorOutput(
        None, [], {"predicted_features": features[0], "target_features": features[1], "point_mass": mass}
    )
    return LOSS(output, training_batch(1))


# -- What is compared --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [point_nerf, surface])
def test_features_at_points_are_the_sums_of_kernels_over_the_nearest_particles(make):
    particles, points = cloud(), torch.rand(1, 7, 3, dtype=torch.float64)

    features = make().double().point_features(particles, points)

    distance = (points[0, :, None] - particles.positions[0]).square().sum(dim=-1).sqrt()
    nearest = distance.topk(SMALL["num_neighbors"], largest=False).indices
    expected = torch.zeros(7, 2, 5, dtype=torch.float64)
    for kernel, (radius, width) in enumerate(zip(SMALL["kernel_radii"], SMALL["kernel_bandwidths"], strict=True)):
        weights = torch.exp(-(((distance - radius) / width) ** 2)).gather(1, nearest)
        expected[:, kernel] = (weights[..., None] * particles.features[0][nearest]).sum(dim=1)
    assert torch.allclose(features[0], expected.flatten(1), atol=1e-12)


@pytest.mark.parametrize("order", [1, -1])
def test_narrowest_mass_is_the_sum_of_the_kernel_that_reaches_least_far(order):
    particles, points = cloud(), torch.rand(1, 7, 3, dtype=torch.float64)
    particles = replace(particles, mask=torch.arange(30)[None] < 20)

    kernels = {name: SMALL[name][::order] for name in ("kernel_radii", "kernel_bandwidths")}
    mass = narrowest_mass(point_nerf(**kernels).double(), particles, points)

    distance = (points[0, :, None] - particles.positions[0, :20]).square().sum(dim=-1).sqrt()
    nearest = distance.topk(SMALL["num_neighbors"], largest=False).values
    assert torch.allclose(mass[0], torch.exp(-((nearest / 0.2) ** 2)).sum(dim=1), atol=1e-12)


def test_identical_clouds_lose_exactly_nothing_and_order_does_not_matter():
    model = sequential().double()
    first, second = cloud(), cloud(seed=2)

    assert compared(model, first, first) == 0
    assert 0 <= compared(model, first, shuffled(first)) < 1e-24
    apart = compared(model, first, second)
    assert apart > 1e-4
    assert torch.allclose(compared(model, shuffled(first), second), apart, rtol=1e-10)


def test_loss_grows_with_a_small_shift():
    model, still = sequential(num_points=400).double(), cloud()
    shifts = [0.0, 0.001, 0.002, 0.005, 0.01, 0.02]

    losses = [
        float(compared(model, replace(still, positions=still.positions + shift * torch.tensor([0.6, 0.0, 0.8])), still))
        for shift in shifts
    ]

    assert losses[0] == 0 and all(small < large for small, large in zip(losses, losses[1:], strict=False))


def test_points_fill_the_workspace_and_change_with_step_and_member():
    model = sequential(num_points=4000)
    keys = RandomKeys(seed=0, step=4, sample_index=[0, 1])

    points = model.draw_points(keys, 0)

    low, high = torch.tensor(WORKSPACE["workspace_min"]), torch.tensor(WORKSPACE["workspace_max"])
    assert points.shape == (2, 4000, 3) and (points >= low).all() and (points <= high).all()
    # 5 standard errors of the mean, and nearly the whole box is reached
    assert (points.mean(dim=1) - (low + high) / 2).abs().max() < 5 * float((high - low).max()) / (12 * 4000) ** 0.5
    assert (points.amin(dim=1) - low < 0.01).all() and (high - points.amax(dim=1) < 0.01).all()
    assert torch.equal(points, model.draw_points(keys, 0))
    others = [points[:1], model.draw_points(keys, 1)[:1], model.draw_points(replace(keys, step=5), 0)[:1], points[1:]]
    assert len({float(other.sum()) for other in others}) == 4


def test_each_step_is_compared_with_the_cloud_of_its_own_frames():
    model, data = sequential(), training_batch()

    output = model(data)

    features = output.auxiliary["target_features"]
    assert output.rendered is None and features.shape == (2, NUM_STEPS, 40, 10)
    assert output.auxiliary["point_mass"].shape == (2, NUM_STEPS, 40)
    for step in range(NUM_STEPS):
        points = model.draw_points(data.keys, step)
        target = model.encoder(data.future[:, step], data.keys, f"future/{step}").particles
        assert torch.equal(features[:, step], model.renderer.point_features(target, points))
        predicted = model.renderer.point_features(output.states[step], points)
        assert torch.equal(output.auxiliary["predicted_features"][:, step], predicted)


def test_dynamics_that_predicts_the_truth_loses_nothing():
    """All pixels become particles and nothing moves, so both clouds are the same in another order."""
    model = sequential(encoder=encoder(num_particles=128, workspace_min=[-9, -9, -9], workspace_max=[9, 9, 9])).double()
    data = training_batch().to(torch.float64)
    now = data.context[:, 1:]
    cameras = now.cameras
    still = RGBDFrames(
        now.rgb.expand(-1, NUM_STEPS, -1, -1, -1, -1),
        now.depth.expand(-1, NUM_STEPS, -1, -1, -1),
        Cameras(
            cameras.intrinsics.expand(-1, NUM_STEPS, -1, -1, -1),
            cameras.cam_to_world.expand(-1, NUM_STEPS, -1, -1, -1),
            8,
            8,
        ),
    )

    assert LOSS(model(replace(data, future=still)), data) < 1e-20
    assert LOSS(model(data), data) > 1e-6


def test_a_batch_loses_the_mean_of_what_its_members_lose():
    """So that a training is the same however many devices share its batch."""
    model, data = sequential(dynamics=Drift(), location_noise=1e-2).train(), training_batch()

    together = LOSS(model(data), data)

    parts = [replace(member(data, index), future=data.future[index : index + 1]) for index in range(2)]
    alone = [LOSS(model(part), part) for part in parts]
    assert abs(alone[0] - alone[1]) > 1e-3 * together
    assert torch.allclose(torch.stack(alone).mean(), together, rtol=1e-5)


# -- What learns -------------------------------------------------------------------------------------------------------


def test_only_the_dynamics_learns_from_features():
    model = sequential(dynamics=Drift(), location_noise=1e-3, checkpoint_dynamics=True).train()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    adam = StepFactorsAdam(
        lr=1e-2, betas=[0.9, 0.999], eps=1e-8, stage_multipliers={"encoder": 1.0}, milestones=[0.5], factors=[0.1]
    )
    optimizer, _ = adam.build(model, 2)

    for _ in range(2):
        optimizer.zero_grad()
        LOSS(model(training_batch()), training_batch()).backward()
        optimizer.step()

    assert [group["name"] for group in optimizer.param_groups] == ["dynamics"]
    assert all(p.grad is None for stage in (model.encoder, model.renderer) for p in stage.parameters())
    assert model.dynamics.step.grad.abs().min() > 0
    changed = [name for name, value in model.state_dict().items() if not torch.equal(value, before[name])]
    assert changed == ["dynamics.step"]
    assert not model.encoder.training and not model.renderer.training and model.dynamics.training


def test_location_noise_is_kept_in_training():
    model, data = sequential(location_noise=0.05).train(), training_batch()

    noisy, quiet = model(data).states[-1], model.eval()(data).states[-1]

    assert (noisy.positions - quiet.positions).abs().max() > 0.02


def test_every_weight_of_encoder_and_renderer_learns_from_the_auto_encoder():
    model, data = AutoEncoder(**stages(location_noise=1e-3)).train(), training_batch()

    PixelLoss(weight=1.0, coarse_weight=1.0)(model(data), data).backward()

    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in model.parameters())
    reached = {name for name, p in model.named_parameters() if p.grad.any()}
    assert any(name.startswith("encoder.network.down.0") for name in reached)
    assert any(name.startswith("renderer.coarse") for name in reached)
    assert any(name.startswith("renderer.fine") for name in reached)


def test_auto_encoder_renders_each_frame_from_that_frame_alone():
    model, data = AutoEncoder(**stages(location_noise=0.1)).eval(), training_batch()

    rendered = model(data).rendered.rgbs

    for step in range(NUM_STEPS):
        particles = model.encoder(data.future[:, step], data.keys, f"future/{step}").particles
        rays = Rays(data.rays.origins[:, step], data.rays.directions[:, step])
        assert torch.allclose(model.renderer(particles, rays, None).rgbs, rendered[:, step], atol=1e-6)
    elsewhere = replace(data, context=batch(seed=9).context)
    assert torch.equal(model(elsewhere).rendered.rgbs, rendered)
    assert not torch.allclose(model.train()(data).rendered.rgbs, rendered, atol=1e-4)  # noise is for training


# -- What is handed over, and used -------------------------------------------------------------------------------------


def test_second_training_starts_from_the_renders_of_the_first():
    first, second = AutoEncoder(**stages(seed=1)), sequential(seed=2, dynamics=Drift())
    weights = first.state_dict()

    assert set(weights) <= set(second.state_dict())
    second.load_state_dict(weights, strict=False)

    data = batch()
    frames, cameras = data.context[0], data.context.cameras[0, 0]
    scenes = [model.encode(frames.rgb, frames.depth, frames.cameras) for model in (first, second)]
    assert torch.equal(scenes[0].current.features, scenes[1].current.features)
    pictures = [model.render([scene.current], cameras) for model, scene in zip((first, second), scenes, strict=True)]
    assert torch.equal(*pictures) and pictures[0].std() > 0


def test_dynamics_that_changes_nothing_is_the_static_scene():
    model, frames = sequential(), batch().context[0]
    cameras = Cameras(frames.cameras.intrinsics[:1], frames.cameras.cam_to_world[:1], 8, 8)
    three = Cameras(cameras.intrinsics.expand(3, -1, -1, -1), cameras.cam_to_world.expand(3, -1, -1, -1), 8, 8)

    predicted = model.predict_frames(frames, three)

    scene = model.encode(frames.rgb, frames.depth, frames.cameras)
    assert predicted.shape == (3, 2, 8, 8, 3)
    assert all(torch.equal(step, model.render([scene.current], cameras[0])[0]) for step in predicted)
    plain = Simulator(**stages(), pixel_gradient_to_motion=1.0)
    plain.load_state_dict(model.state_dict())
    assert torch.equal(plain.predict_frames(frames, three), predicted)  # it is used as the end-to-end model is


def test_paper_settings_and_both_trainings_fit_each_other():
    paper = compose("train", ["experiment=mujoco_block", "model=sequential", "run.folder=nowhere"])
    first = pretraining_config(paper)
    tiny = compose("train", ["experiment=mujoco_block", "model=sequential", "budget=tiny", "run.folder=nowhere"])
    tiny_first = pretraining_config(tiny)

    assert (first["trainer"]["max_steps"], paper["trainer"]["max_steps"]) == (100_000, 400_000)
    assert paper["optimizer"] == first["optimizer"] and paper["optimizer"]["lr"] == 1e-4
    assert paper["optimizer"]["factors"] == pytest.approx([1 / 10, 1 / 3])
    assert paper["model"]["num_points"] == 2**14 and paper["data"]["num_steps"] == 6
    assert first["data"]["num_steps"] == 1 and first["data"]["load_future"] and paper["data"]["load_future"]
    assert [name for name, loss in first["loss"].items() if loss] == ["pixel"] and list(paper["loss"]) == [
        "point_features"
    ]
    one, other = build_simulator(tiny_first), build_simulator(tiny)
    assert isinstance(one, AutoEncoder) and isinstance(other, SequentialSimulator)
    assert set(one.state_dict()) == {name for name in other.state_dict() if name.startswith(("encoder.", "renderer."))}


def test_what_cannot_work_is_refused():
    with pytest.raises(ConfigError, match="load_future"):
        sequential()(batch())
    with pytest.raises(ConfigError, match="load_future"):
        AutoEncoder(**stages())(batch())
    with pytest.raises(ValueError, match="dynamics=persistence"):
        AutoEncoder(**stages(dynamics=Drift()))
    with pytest.raises(ValueError, match="renderer=point_nerf"):
        sequential(renderer=renderer())
    with pytest.raises(ValueError, match="num_points"):
        sequential(num_points=0)
    with pytest.raises(ValueError, match="workspace_min"):
        sequential(workspace_min=[2, 2, 2])
