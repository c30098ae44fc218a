"""The encoder on depth images with holes, on images at the ends of their range, and in scaled worlds."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.stability.hard_scenes import Mode, is_finite
from tests.stability.known_faults import known_fault
from tests.stability.stages import options, stage
from vpd_lightning.encoder.base import AbstractEncoder
from vpd_lightning.errors import EmptyWorkspaceError
from vpd_lightning.geometry.cameras import project, unproject
from vpd_lightning.geometry.normals import depth_normals
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.testing.scenes import ball_frames, ring_cameras
from vpd_lightning.types import RGBDFrames

KEYS = RandomKeys(seed=1, step=2, sample_index=[0, 1])
MISSING = (0.0, torch.nan, torch.inf, -torch.inf, -1.0)


@pytest.fixture(params=options("encoder"))
def option(request: pytest.FixtureRequest) -> str:
    return request.param


def frames_for(mode: Mode, device: torch.device) -> RGBDFrames:
    frames = ball_frames()
    return replace(frames, depth=frames.depth.float().double()).to(device, mode.dtype)


def require_measured_places(option: str) -> None:
    """Skip encoders whose particles do not lie where depth was measured, by design."""
    if option.startswith(("global_scene", "unet_depth")):
        pytest.skip("its particles do not lie where depth was measured")


def fitted(option: str, mode: Mode, device: torch.device, **changes) -> AbstractEncoder:
    encoder = stage("encoder", option, mode, device, **changes)
    if getattr(encoder, "background", None) is not None and encoder.background.needs_fit:
        empty = ball_frames(batch_size=1, has_ball=False).to(device, mode.dtype)
        encoder.background.fit(empty.rgb[0], empty.depth[0], empty.cameras[0])
    return encoder


def encoded_with_gradients(encoder, frames: RGBDFrames, mode: Mode, device: torch.device):
    with mode.context(device):
        particles = encoder(frames, KEYS, "current").particles
    weights = [p for p in encoder.parameters() if p.requires_grad]
    gradients = torch.autograd.grad(particles.features.sum(), weights, materialize_grads=True)
    assert particles.positions.dtype == particles.features.dtype == mode.dtype
    assert is_finite(particles.positions, particles.features, particles.colors, particles.normals, *gradients)
    return particles


def _half(values: Tensor, missing: float) -> Tensor:
    values = values.clone()
    values[..., ::2] = missing
    return values


def _all_but_one(values: Tensor, missing: float) -> Tensor:
    kept = torch.full_like(values, missing)
    kept[:, 0, 9, 8] = values[:, 0, 9, 8]
    return kept


def _one_view(values: Tensor, missing: float) -> Tensor:
    values = values.clone()
    values[:, 1] = missing
    return values


HOLES: dict[str, Callable[[Tensor, float], Tensor]] = {
    "every_second_column": _half,
    "all_but_one_pixel": _all_but_one,
    "a_whole_view": _one_view,
}


@pytest.mark.parametrize("missing", MISSING)
@pytest.mark.parametrize("holes", HOLES)
def test_missing_depth_is_masked(option: str, holes: str, missing: float, mode: Mode, device: torch.device):
    require_measured_places(option)
    frames = frames_for(mode, device)
    broken = replace(frames, depth=HOLES[holes](frames.depth, missing))

    particles = encoded_with_gradients(fitted(option, mode, device), broken, mode, device)

    measured = torch.isfinite(broken.depth) & (broken.depth > 0)
    points = unproject(broken.depth, broken.cameras)
    for member in range(2):
        seen = points[member][measured[member]]
        ours = particles.positions[member][particles.mask[member]]
        # Every particle is one of the measured points, and none is missing among few.
        assert ((ours[:, None] - seen).abs().amax(dim=-1).amin(dim=1) == 0).all()
    assert particles.mask.any(dim=1).all() or option != "unet"


@pytest.mark.parametrize("missing", [0.0, torch.nan, torch.inf, 1e6])
def test_nothing_in_the_workspace_is_refused_by_name(option: str, missing: float, mode: Mode, device: torch.device):
    require_measured_places(option)
    frames = frames_for(mode, device)

    with pytest.raises(EmptyWorkspaceError, match="no measured pixel of batch member 0"):
        fitted(option, mode, device)(replace(frames, depth=torch.full_like(frames.depth, missing)), KEYS, "current")


@pytest.mark.parametrize("value", [0, 255])
@pytest.mark.parametrize("is_float", [False, True])
def test_images_of_one_colour(option: str, value: int, is_float: bool, mode: Mode, device: torch.device):
    frames = frames_for(mode, device)
    rgb = torch.full_like(frames.rgb, value)

    encoded_with_gradients(
        fitted(option, mode, device), replace(frames, rgb=rgb.to(mode.dtype) / 255 if is_float else rgb), mode, device
    )


@pytest.mark.parametrize("gain", [0.0, 1e-20, 1e3, 1e6])
def test_weights_of_any_size(option: str, gain: float, mode: Mode, device: torch.device):
    require_measured_places(option)
    """Softplus keeps features positive and, where its argument is huge, linear."""
    encoder = fitted(option, mode, device)
    with torch.no_grad():
        encoder.network.up[-1].weight.mul_(gain)

    particles = encoded_with_gradients(encoder, frames_for(mode, device), mode, device)

    assert (particles.features >= 0).all()


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e3, 1e6])
def test_worlds_of_any_size(option: str, factor: float, mode: Mode, device: torch.device):
    require_measured_places(option)
    if "background" in option or "moving" in option:
        pytest.skip("its depth threshold is in metres")
    frames = frames_for(mode, device)
    pose = frames.cameras.cam_to_world.clone()
    pose[..., :3, 3] *= factor
    scaled = replace(frames, depth=frames.depth * factor, cameras=replace(frames.cameras, cam_to_world=pose))

    here = encoded_with_gradients(fitted(option, mode, device), frames, mode, device)
    there = encoded_with_gradients(fitted(option, mode, device, scale=factor), scaled, mode, device)

    # The same pixels are chosen; their places are rounded in another binade: a few eps of the metre they are away.
    torch.testing.assert_close(there.positions / factor, here.positions, rtol=0, atol=16 * mode.eps)
    torch.testing.assert_close(there.features, here.features, rtol=0, atol=0)


def test_float32_places_are_those_of_float64(option: str, device: torch.device):
    single, double = Mode("float32", torch.float32), Mode("float64", torch.float64)
    frames = frames_for(single, device)

    ours = unproject(frames.depth, frames.cameras)
    exact = unproject(frames.depth.double(), frames.cameras.to(double.dtype))

    # Three products and sums of numbers around a metre, each rounded once.
    seen = exact.abs().amax()
    torch.testing.assert_close(ours.double(), exact, rtol=0, atol=float(16 * single.eps * seen))


def test_autocast_does_not_move_particles(option: str, device: torch.device):
    require_measured_places(option)
    single, half = Mode("float32", torch.float32), Mode("bf16", torch.float32, is_autocast=True)
    frames = frames_for(single, device)

    places = [encoded_with_gradients(fitted(option, mode, device), frames, mode, device) for mode in (single, half)]

    assert torch.equal(places[0].positions, places[1].positions) and torch.equal(places[0].mask, places[1].mask)


@pytest.mark.parametrize("shift", [1e3, 1e6])
def test_a_translated_camera_gives_translated_points(shift: float, device: torch.device):
    cameras = ring_cameras().to(device)
    pose = cameras.cam_to_world.clone()
    pose[..., :3, 3] += shift
    depth = ball_frames(batch_size=1).depth[0].to(device)

    here = unproject(depth, cameras)
    moved = replace(cameras, cam_to_world=pose)
    there = unproject(depth, moved)
    pixels, again = project(there[depth > 0].view(-1, 3)[None], moved[:1])

    torch.testing.assert_close(there - shift, here, rtol=0, atol=4 * 2.0**-52 * shift)
    assert is_finite(pixels, again)


@pytest.mark.parametrize("missing", MISSING)
def test_normals_beside_missing_depth_are_unit_or_zero(missing: float, mode: Mode, device: torch.device):
    frames = frames_for(mode, device)
    depth = frames.depth.clone()
    depth[..., 3:6, 7] = missing

    normals = depth_normals(depth, frames.cameras)

    length = normals.norm(dim=-1)
    assert is_finite(normals)
    assert (((length - 1).abs() < 16 * mode.eps) | (length == 0)).all()


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_normals_do_not_depend_on_the_size_of_the_world(
    factor: float, mode: Mode, device: torch.device, request: pytest.FixtureRequest
):
    known_fault(request, "tiny_normals", factor == 1e-6)
    frames = frames_for(mode, device)
    pose = frames.cameras.cam_to_world.clone()
    pose[..., :3, 3] *= factor

    normals = depth_normals(frames.depth * factor, replace(frames.cameras, cam_to_world=pose))

    # The steps between pixels are differences of places, known to eps of the distance: 1e-5 of a step in float32.
    expected = depth_normals(frames.depth, frames.cameras)
    inner = expected.norm(dim=-1) > 0
    assert (normals.norm(dim=-1)[inner] > 0.99).all()
    torch.testing.assert_close(normals, expected, rtol=0, atol=3e3 * mode.eps)
