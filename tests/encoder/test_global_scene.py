from dataclasses import replace

import pytest
import torch

from vpd_lightning.encoder.global_scene import GlobalSceneEncoder
from vpd_lightning.encoder.networks.resnet import ResNetTrunk
from vpd_lightning.errors import DataError
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Cameras, RGBDFrames

SMALL = {
    "feature_dim": 12,
    "hidden_dim": 10,
    "widths": [4, 8],
    "blocks": [1, 2],
    "num_groups": 2,
    "height": 16,
    "width": 24,
    "workspace_min": [-2.0, -1.0, 0.0],
    "workspace_max": [2.0, 1.0, 1.0],
}


def encoder_of(seed: int = 0, **changes: object) -> GlobalSceneEncoder:
    torch.manual_seed(seed)
    return GlobalSceneEncoder(**(SMALL | changes)).double()


def frames_of(num_views: int, batch: int = 2, height: int = 16, width: int = 24, seed: int = 0) -> RGBDFrames:
    generator = torch.Generator().manual_seed(seed)
    draw = {"generator": generator, "dtype": torch.float64}
    turned = torch.linalg.qr(torch.randn(batch, num_views, 3, 3, **draw))[0]
    cam_to_world = torch.eye(4, dtype=torch.float64).repeat(batch, num_views, 1, 1)
    cam_to_world[..., :3, :3] = turned * torch.linalg.det(turned)[..., None, None]
    cam_to_world[..., :3, 3] = torch.randn(batch, num_views, 3, **draw)
    intrinsics = torch.tensor([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]], dtype=torch.float64)
    return RGBDFrames(
        torch.rand(batch, num_views, height, width, 3, **draw),
        torch.rand(batch, num_views, height, width, **draw),
        Cameras(intrinsics.expand(batch, num_views, 3, 3), cam_to_world, height, width),
    )


def state_of(encoder: GlobalSceneEncoder, frames: RGBDFrames) -> torch.Tensor:
    return encoder(frames, RandomKeys.fixed(len(frames.rgb)), "current").particles.features[:, 0]


@pytest.mark.parametrize("num_groups", [32, None])
def test_the_trunk_has_the_parameters_of_resnet_18(num_groups: int | None) -> None:
    trunk = ResNetTrunk(in_channels=3, widths=[64, 128, 256, 512], blocks=[2, 2, 2, 2], num_groups=num_groups)
    assert sum(parameter.numel() for parameter in trunk.parameters()) == 11_176_512


@pytest.mark.parametrize(("height", "width"), [(128, 128), (64, 96), (16, 16), (65, 33)])
def test_the_size_of_the_map_is_known_beforehand(height: int, width: int) -> None:
    trunk = ResNetTrunk(in_channels=3, widths=[2, 2, 2, 2], blocks=[1, 1, 1, 1], num_groups=1)
    assert trunk(torch.rand(1, 3, height, width)).shape[-2:] == trunk.map_size(height, width)
    assert trunk.map_size(128, 128) == (4, 4)


def test_parameter_counts_at_full_size() -> None:
    encoder = GlobalSceneEncoder(
        **SMALL
        | {"feature_dim": 256, "hidden_dim": 256, "widths": [64, 128, 256, 512], "blocks": [2, 2, 2, 2]}
        | {"num_groups": 32, "height": 128, "width": 128}
    )
    parts = {name: sum(p.numel() for p in part.parameters()) for name, part in encoder.named_children()}
    networks = {"image_head": 8192 * 256 + 256, "view_network": 135_680, "state_network": 131_584}
    assert parts == {"trunk": 11_176_512} | networks and networks["image_head"] == 2_097_408


@pytest.mark.parametrize("num_views", [1, 4, 9])
def test_any_number_of_views_gives_one_unit_vector_at_the_origin(num_views: int) -> None:
    particles = encoder_of()(frames_of(num_views), RandomKeys.fixed(2), "current").particles
    assert particles.features.shape == (2, 1, 12) and not particles.positions.any() and particles.mask.all()
    torch.testing.assert_close(particles.features.norm(dim=-1), torch.ones(2, 1, dtype=torch.float64))


def test_the_order_of_views_and_copies_of_them_change_nothing() -> None:
    encoder, frames = encoder_of(), frames_of(4)
    state = state_of(encoder, frames)
    for index in ([2, 0, 3, 1], [0, 1, 2, 3, 0, 1, 2, 3]):
        torch.testing.assert_close(state_of(encoder, frames[:, index]), state, rtol=0, atol=1e-12)
    assert not torch.allclose(state_of(encoder, frames[:, [0, 0, 0, 1]]), state, atol=1e-6)


def test_the_camera_alone_changes_the_state() -> None:
    encoder, frames = encoder_of(), frames_of(1)
    moved = frames.cameras.cam_to_world.clone()
    moved[..., :3, 3] += 0.3
    other = replace(frames, cameras=replace(frames.cameras, cam_to_world=moved))
    assert (state_of(encoder, other) - state_of(encoder, frames)).abs().max() > 1e-6


def test_the_camera_enters_as_world_to_camera_in_units_of_half_the_workspace() -> None:
    encoder, frames = encoder_of(), frames_of(3)
    expected = torch.linalg.inv(frames.cameras.cam_to_world)
    expected[..., :3, 3] /= 2.0  # half of the longest side, from -2 to 2
    matrices = encoder._view_matrices(frames.cameras.cam_to_world)
    torch.testing.assert_close(matrices, expected.flatten(-2), rtol=1e-9, atol=1e-12)


def test_depth_is_never_looked_at() -> None:
    encoder, frames = encoder_of(), frames_of(2)
    poisoned = replace(frames, depth=torch.full_like(frames.depth, torch.nan))
    assert torch.equal(state_of(encoder, poisoned), state_of(encoder, frames))
    state_of(encoder, poisoned).sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in encoder.parameters())


def test_group_normalisation_keeps_members_apart_and_batch_normalisation_is_a_choice() -> None:
    frames = frames_of(2)
    torch.testing.assert_close(state_of(encoder_of(), frames[:1]), state_of(encoder_of(), frames)[:1])
    batch = encoder_of(num_groups=None)
    assert any(name.endswith("running_mean") for name in batch.state_dict())
    together = state_of(batch, frames)[:1]
    assert not torch.allclose(state_of(batch, frames[:1]), together, atol=1e-6)


def test_images_of_another_size_are_refused_with_what_to_set() -> None:
    with pytest.raises(DataError, match=r"16x16.*16x24.\n.*encoder.width=16"):
        state_of(encoder_of(), frames_of(2, width=16))


def test_the_state_has_unit_length_in_float32_under_autocast() -> None:
    encoder, frames = encoder_of().float(), frames_of(2).to(torch.float32)
    exact = state_of(encoder, frames)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = state_of(encoder, frames)
    assert rounded.dtype == torch.float32
    torch.testing.assert_close(rounded.norm(dim=-1), torch.ones(2), rtol=0, atol=1e-6)
    torch.testing.assert_close(rounded, exact, rtol=0, atol=0.05)  # bf16 keeps two to three digits


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("hidden_dim", 0),
        ("height", 0),
        ("num_groups", 3),
        ("blocks", [1]),
        ("widths", [4, 0]),
        ("workspace_min", [2.0, 0.0, 0.0]),
    ],
)
def test_values_out_of_range_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        GlobalSceneEncoder(**(SMALL | {name: value}))
