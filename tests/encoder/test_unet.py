import pytest
import torch

from vpd_lightning.encoder.networks.unet_network import UNetNetwork
from vpd_lightning.encoder.particles.fixed_camera_background import BackgroundModel
from vpd_lightning.encoder.unet import UNetEncoder
from vpd_lightning.errors import DataError, EmptyWorkspaceError
from vpd_lightning.geometry.cameras import project
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Cameras, RGBDFrames


def looking_down(num_views=2, size=8):
    cam_to_world = torch.eye(4).repeat(num_views, 1, 1)
    cam_to_world[:, :3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    cam_to_world[:, 2, 3] = 2.0
    cam_to_world[:, 0, 3] = torch.arange(num_views) * 0.1
    intrinsics = torch.tensor([[8.0, 0, 4.0], [0, 8.0, 4.0], [0, 0, 1]]).expand(num_views, 3, 3)
    return Cameras(intrinsics, cam_to_world, size, size)


def frames(batch=2, num_views=2, size=8, seed=0):
    generator = torch.Generator().manual_seed(seed)
    cameras = looking_down(num_views, size)
    return RGBDFrames(
        torch.randint(0, 256, (batch, num_views, size, size, 3), generator=generator, dtype=torch.uint8),
        torch.full((batch, num_views, size, size), 2.0),
        Cameras(cameras.intrinsics.expand(batch, -1, 3, 3), cameras.cam_to_world.expand(batch, -1, 4, 4), size, size),
    )


def encoder(**changes):
    arguments = {
        "channels": [8, 12, 8, 12, 5],
        "num_particles": 40,
        "workspace_min": [-2, -2, -1],
        "workspace_max": [2, 2, 1],
        "moving_fraction": None,
        "background": None,
        "use_normals": False,
        "color_features": False,
        "same_pixels": False,
        "has_scenery": False,
        "has_driven": False,
    }
    return UNetEncoder(**{**arguments, **changes})


def test_particles_lie_on_measured_surfaces_with_positive_features():
    particles = encoder()(frames(), RandomKeys.fixed(2), "current").particles

    assert particles.positions.shape == (2, 40, 3) and particles.features.shape == (2, 40, 5)
    assert particles.mask.all()
    assert particles.positions[..., 2].abs().max() < 1e-5
    assert (particles.features > 0).all()


def test_a_particle_carries_the_features_and_colour_of_its_pixel():
    model, data = encoder(), frames(batch=1, num_views=1)

    particles = model(data, RandomKeys.fixed(1), "current").particles

    pixels, _ = project(particles.positions[0], data.cameras[0, 0])
    x, y = pixels.floor().long().unbind(-1)
    features = model.pixel_features(data.rgb.float() / 255)[0, 0]
    assert torch.allclose(particles.features[0], features[y, x], atol=1e-6)
    assert torch.allclose(particles.colors[0], data.rgb[0, 0, y, x].float() / 255)


def test_a_batch_equals_its_members():
    model, data = encoder(), frames()
    together = model(data, RandomKeys(0, 3, [0, 1]), "current").particles

    alone = model(data[1:], RandomKeys(0, 3, [1]), "current").particles

    assert torch.equal(together.positions[1:], alone.positions)  # 40 of 128 pixels: every pixel is convolved
    assert torch.allclose(together.features[1:], alone.features, atol=1e-6)


def test_missing_depth_and_pixels_outside_the_workspace_make_no_particles():
    data = frames(batch=1, num_views=1)
    data.depth[0, 0, :, :4] = 0.0
    data.depth[0, 0, 0] = float("nan")

    particles = encoder(num_particles=64)(data, RandomKeys.fixed(1), "current").particles

    assert int(particles.mask.sum()) == 7 * 4
    assert torch.isfinite(particles.positions).all() and torch.isfinite(particles.features).all()
    assert (particles.positions[~particles.mask] == 0).all()


def test_an_empty_workspace_is_an_error_that_says_what_to_check():
    with pytest.raises(EmptyWorkspaceError, match="workspace"):
        encoder(workspace_min=[5, 5, 5], workspace_max=[6, 6, 6])(frames(), RandomKeys.fixed(2), "current")


def test_the_last_convolution_at_chosen_pixels_equals_the_whole_one():
    torch.manual_seed(0)
    network = UNetNetwork(channels=[4, 6, 8, 6, 5], in_channels=3).double()
    images = torch.rand(3, 3, 8, 12, dtype=torch.float64)
    pixels = torch.randperm(3 * 8 * 12)[:150]  # borders and corners among them, some images more often than others

    chosen = network.at_pixels(images, pixels)
    whole = network(images).movedim(1, -1).flatten(0, 2)[pixels]

    assert torch.allclose(chosen, whole, atol=1e-12)
    seed = torch.randn_like(chosen)
    fast = torch.autograd.grad((chosen * seed).sum(), list(network.parameters()))
    plain = torch.autograd.grad((whole * seed).sum(), list(network.parameters()))
    for a, b in zip(fast, plain, strict=True):
        assert torch.allclose(a, b, atol=1e-10)


@pytest.mark.parametrize("num_particles", [8, 40])
def test_few_and_many_particles_get_the_features_of_their_pixels(num_particles):
    model, data = encoder(num_particles=num_particles), frames()

    particles = model(data, RandomKeys.fixed(2), "current").particles

    every = model.pixel_features(data.rgb.float() / 255).flatten(1, 3)
    gaps = (particles.features[:, :, None] - every[:, None]).abs().amax(-1).amin(-1)
    assert gaps.max() < 1e-6


def test_image_sizes_that_the_network_cannot_halve_are_refused():
    with pytest.raises(ValueError, match="multiple of 4"):
        UNetNetwork(channels=[4, 4, 4, 4, 4], in_channels=3)(torch.zeros(1, 3, 6, 8))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_particles": 0}, "num_particles"),
        ({"workspace_min": [3, 0, 0]}, "workspace_min"),
        ({"moving_fraction": 0.5}, "background"),
        ({"channels": [4, 4]}, "channels"),
    ],
)
def test_wrong_settings_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        encoder(**changes)


def fitted_background(data):
    model = BackgroundModel(num_views=2, height=8, width=8, depth_threshold=0.02)
    model.fit(data.rgb[0], data.depth[0], data.cameras[0])
    return model


def test_background_marks_what_stands_in_front_and_particles_favour_it():
    data = frames(batch=1)
    background = fitted_background(data)
    closer = RGBDFrames(data.rgb, data.depth.clone(), data.cameras)
    closer.depth[0, 1, 2:4, 2:4] = 1.5

    moving = background(closer)
    model = encoder(moving_fraction=0.25, background=background)
    particles = model(closer, RandomKeys.fixed(1), "current").particles

    assert int(moving.sum()) == 4 and moving[0, 1, 2:4, 2:4].all()
    still = ~particles.moving[0]
    pixels, _ = project(particles.positions[0, still], closer.cameras[0, 1])
    # within view 1 nothing static lies beside what moves: pixels 1 to 4 in both directions
    near = ((pixels - 3.0).abs() < 1.99).all(-1)
    from_view_1 = (pixels.frac() - 0.5).abs().amax(-1) < 1e-3
    assert not (near & from_view_1 & particles.mask[0, still]).any()
    assert int(particles.moving.sum()) == 4
    assert (particles.positions[particles.moving][:, 2] > 0.4).all()
    assert "background.depth" in model.state_dict()


def test_what_stands_still_takes_the_places_that_nothing_moving_fills():
    data = frames(batch=1)
    background = fitted_background(data)
    closer = RGBDFrames(data.rgb, data.depth.clone(), data.cameras)
    closer.depth[0, 1, 2:4, 2:4] = 1.5

    model = encoder(moving_fraction=0.5, background=background)  # of 40 particles 20 may move, and four do
    particles = model(closer, RandomKeys.fixed(1), "current").particles

    assert particles.mask.all()
    assert int(particles.moving.sum()) == 4
    assert len(particles.positions[0].unique(dim=0)) == 40


def test_the_first_features_are_the_colours_where_asked_for():
    data = frames()
    plain, colored = (encoder(color_features=asked) for asked in (False, True))
    colored.load_state_dict(plain.state_dict())

    before, now = (model(data, RandomKeys.fixed(2), "current").particles for model in (plain, colored))

    assert torch.equal(now.features[..., :3], now.colors)
    assert torch.equal(now.features[..., 3:], before.features[..., 3:])
    with pytest.raises(ValueError, match="feature_dim of at least 3"):
        encoder(channels=[4, 4, 2], color_features=True)


def test_background_finds_its_cameras_in_any_order_and_refuses_strangers():
    data = frames(batch=1)
    background = fitted_background(data)
    swapped = RGBDFrames(data.rgb.flip(1), data.depth, Cameras(
        data.cameras.intrinsics, data.cameras.cam_to_world.flip(1), 8, 8))  # fmt: skip
    assert not background(swapped).any()

    stranger = data.cameras.cam_to_world.clone()
    stranger[..., 1, 3] += 0.5
    with pytest.raises(DataError, match="fixed cameras"):
        background(RGBDFrames(data.rgb, data.depth, Cameras(data.cameras.intrinsics, stranger, 8, 8)))


def test_background_must_be_fitted_first():
    model = BackgroundModel(num_views=2, height=8, width=8, depth_threshold=0.02)
    with pytest.raises(DataError, match="fitted"):
        model(frames())


def test_the_same_pixels_are_chosen_in_both_frames_wherever_they_are_candidates():
    before = frames(batch=2, num_views=1)
    after = RGBDFrames(before.rgb, before.depth.clone(), before.cameras)
    after.depth[:, :, 2] = 0.0  # a row of eight pixels is not measured in the second frame

    def places(same_pixels, seen, purpose):
        model = encoder(same_pixels=same_pixels, num_particles=30)
        made = model(seen, RandomKeys(0, 0, [0, 1]), purpose).particles
        return [{tuple(place) for place in p[m].tolist()} for p, m in zip(made.positions, made.mask, strict=True)]

    same = list(zip(places(True, before, "previous"), places(True, after, "current"), strict=True))
    drawn = list(zip(places(False, before, "previous"), places(False, after, "current"), strict=True))

    for first, second in same:
        assert len(first) == len(second) == 30
        assert {place for place in first if place in second} >= {place for place in first if row_of(place) != 2}
    assert same[0][0] != same[1][0]  # members draw their own
    assert all(len(first & second) < 22 for first, second in drawn)


def row_of(place):
    camera = looking_down(1)
    pixel, _ = project(torch.tensor(place), camera[0])
    return int(pixel[1])


def test_same_pixels_pad_where_there_are_fewer_candidates_than_particles():
    data = frames(batch=2, num_views=1)
    data.depth[:, :, 1:] = 0.0

    made = encoder(same_pixels=True)(data, RandomKeys(0, 0, [0, 1]), "current").particles

    assert made.mask.sum(dim=1).tolist() == [8, 8] and made.mask[:, :8].all()
    assert not made.positions[:, 8:].any() and not made.features[:, 8:].any()
    more = encoder(same_pixels=True, num_particles=100)(data, RandomKeys(0, 0, [0, 1]), "current").particles
    assert more.mask.shape == (2, 100) and more.mask.sum(dim=1).tolist() == [8, 8]


def test_a_background_takes_the_shape_of_what_is_fitted_and_loaded():
    data = frames(batch=1)
    free = {"num_views": None, "height": None, "width": None, "depth_threshold": 0.02}
    model, other = BackgroundModel(**free), BackgroundModel(**free)
    model.fit(data.rgb[0], data.depth[0], data.cameras[0])
    assert model.depth.shape == data.depth[0].shape and bool(model.is_fitted)

    other.load_state_dict(model.state_dict())

    nearer = RGBDFrames(data.rgb, data.depth - 0.1, data.cameras)
    assert torch.equal(other(nearer), model(nearer)) and bool(other(nearer).all())
    fixed = BackgroundModel(num_views=1, height=8, width=8, depth_threshold=0.02)
    with pytest.raises(DataError, match="the model expects"):
        fixed.fit(data.rgb[0], data.depth[0], data.cameras[0])
