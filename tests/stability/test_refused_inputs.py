"""NaN and infinity in every input of every stage: refused by the name of the input, or without any influence."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.stability.hard_scenes import Mode, is_finite
from tests.stability.known_faults import known_fault
from tests.stability.stages import options, stage
from vpd_lightning.errors import NonFiniteError
from vpd_lightning.testing.scenes import ball_frames, ball_particles, keys_for, scene_rays
from vpd_lightning.types import Particles

FLOAT64 = Mode("float64", torch.float64)
CPU = torch.device("cpu")
KEYS = keys_for(2)
BAD = (torch.nan, torch.inf, -torch.inf)


@pytest.fixture(params=BAD, ids=str)
def bad(request: pytest.FixtureRequest) -> float:
    return request.param


def with_one(values: Tensor, bad: float) -> Tensor:
    """Return a copy with one bad number in the middle of the last member of the batch."""
    values = values.clone()
    flat = values[-1].view(-1)
    flat[len(flat) // 2] = bad
    return values


def with_bad_padding(particles: Particles, bad: float, count: int) -> Particles:
    """Return the particles with everything in the first ``count`` slots bad and masked."""
    changes: dict[str, Tensor] = {}
    for name in ("positions", "features", "colors", "normals"):
        values = getattr(particles, name).clone()
        values[:, :count] = bad
        changes[name] = values
    mask = particles.mask.clone()
    mask[:, :count] = False
    return replace(particles, mask=mask, **changes)


def refused(call: Callable[[], Any], name: str) -> None:
    """Check that a call stops with an error that names the input, and no other input."""
    with pytest.raises(NonFiniteError) as caught:
        call()
    first_line = str(caught.value).splitlines()[0]
    assert name in first_line, first_line
    others = {"positions", "features", "rays", "cameras", "rgb", "colors", "normals"} - {name}
    assert not [other for other in others if other in first_line], first_line


# -- renderers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("option", options("renderer"))
@pytest.mark.parametrize("name", ["positions", "features"])
def test_renderers_refuse_bad_particles(option: str, name: str, bad: float, request: pytest.FixtureRequest):
    if option.startswith("global_nerf") and name == "positions":
        pytest.skip("not read")
    known_fault(request, "features_unchecked" if name == "features" else "positions_unnamed")
    renderer, (_, particles) = stage("renderer", option, FLOAT64, CPU), ball_particles()
    broken = replace(particles, **{name: with_one(getattr(particles, name), bad)})

    refused(lambda: renderer(broken, scene_rays(), KEYS), name)


@pytest.mark.parametrize("option", options("renderer"))
@pytest.mark.parametrize("name", ["origins", "directions"])
def test_renderers_refuse_bad_rays(option: str, name: str, bad: float, request: pytest.FixtureRequest):
    known_fault(request, "positions_unnamed")
    renderer, (_, particles), rays = stage("renderer", option, FLOAT64, CPU), ball_particles(), scene_rays()

    refused(lambda: renderer(particles, replace(rays, **{name: with_one(getattr(rays, name), bad)}), KEYS), "rays")


@pytest.mark.parametrize("option", options("renderer"))
@pytest.mark.parametrize("count", [3, 38, 40])
def test_padding_never_reaches_a_picture(option: str, count: int, bad: float, request: pytest.FixtureRequest):
    """40 slots, of which 3, all but 2, and all are padding."""
    known_fault(request, "padding_in_pictures", option in ("splat", "surface") and count > 3)
    renderer, (_, particles), rays = stage("renderer", option, FLOAT64, CPU), ball_particles(), scene_rays()
    broken = with_bad_padding(particles, bad, count)
    positions, features = broken.positions.clone().requires_grad_(), broken.features.clone().requires_grad_()

    rendered = renderer(replace(broken, positions=positions, features=features), rays, KEYS)
    clean = renderer(with_bad_padding(particles, 0.0, count), rays, KEYS)
    weights = [p for p in renderer.parameters() if p.requires_grad]
    gradients = torch.autograd.grad(rendered.rgbs.sum(), [positions, features, *weights], materialize_grads=True)

    assert is_finite(rendered.rgbs, rendered.depths, *gradients)
    torch.testing.assert_close(rendered.rgbs, clean.rgbs, rtol=0, atol=1e-9)


# -- dynamics ----------------------------------------------------------------------------------------------------------


def stepped(dynamics: Any, previous: Particles, current: Particles) -> Particles:
    memory = dynamics.initialize(previous, current, KEYS)
    return dynamics(previous, current, memory, KEYS, 0)[0]


@pytest.mark.parametrize("option", [name for name in options("dynamics") if name != "persistence"])
@pytest.mark.parametrize("name", ["positions", "features"])
@pytest.mark.parametrize("when", ["previous", "current"])
def test_dynamics_refuses_bad_particles(option: str, when: str, name: str, bad: float, request: pytest.FixtureRequest):
    if option.startswith("inertial") and (when, name) == ("previous", "features"):
        pytest.skip("not read")
    if option.startswith("global_mlp") and name == "positions":
        pytest.skip("not read")
    if option.startswith("inertial"):
        known_fault(request, "inertial_unchecked")
    else:
        known_fault(request, "features_unchecked" if name == "features" else "positions_unnamed")
    dynamics, (previous, current) = stage("dynamics", option, FLOAT64, CPU), ball_particles()
    pair = {"previous": previous, "current": current}
    pair[when] = replace(pair[when], **{name: with_one(getattr(pair[when], name), bad)})

    refused(lambda: stepped(dynamics, pair["previous"], pair["current"]), name)


@pytest.mark.parametrize("when, name", [("previous", "colors"), ("current", "colors"), ("current", "normals")])
def test_inertial_dynamics_refuses_bad_observations(when: str, name: str, bad: float, request: pytest.FixtureRequest):
    known_fault(request, "inertial_unchecked")
    dynamics, (previous, current) = stage("dynamics", "inertial", FLOAT64, CPU), ball_particles()
    pair = {"previous": previous, "current": current}
    values = getattr(pair[when], name).clone()
    values[-1, pair[when].moving[-1].nonzero()[0, 0], 0] = bad
    pair[when] = replace(pair[when], **{name: values})

    refused(lambda: stepped(dynamics, pair["previous"], pair["current"]), name)


@pytest.mark.parametrize("option", options("dynamics"))
@pytest.mark.parametrize("count", [3, 38, 40])
def test_padding_never_reaches_a_state(option: str, count: int, bad: float, request: pytest.FixtureRequest):
    known_fault(request, "padding_in_matching", option.startswith("inertial"))
    dynamics, (previous, current) = stage("dynamics", option, FLOAT64, CPU), ball_particles()

    broken = stepped(dynamics, *(with_bad_padding(particles, bad, count) for particles in (previous, current)))
    clean = stepped(dynamics, *(with_bad_padding(particles, 0.0, count) for particles in (previous, current)))
    weights = [p for p in dynamics.parameters() if p.requires_grad]

    for name in ("positions", "features"):
        ours, theirs = getattr(broken, name)[:, count:], getattr(clean, name)[:, count:]
        assert is_finite(ours)
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9)
    total = broken.positions[:, count:].sum() + broken.features[:, count:].sum()
    if total.requires_grad:
        assert is_finite(*torch.autograd.grad(total, weights, materialize_grads=True))


# -- encoder (missing depth is masked: test_encoder_stability.py) ------------------------------------------------------


@pytest.mark.parametrize("option", ["unet"])
def test_encoder_refuses_bad_images(option: str, bad: float, request: pytest.FixtureRequest):
    known_fault(request, "images_and_cameras_unchecked")
    encoder, frames = stage("encoder", option, FLOAT64, CPU), ball_frames()

    refused(lambda: encoder(replace(frames, rgb=with_one(frames.rgb.double() / 255, bad)), KEYS, "current"), "rgb")


@pytest.mark.parametrize("option", ["unet"])
@pytest.mark.parametrize("name", ["intrinsics", "cam_to_world"])
def test_encoder_refuses_bad_cameras(option: str, name: str, bad: float, request: pytest.FixtureRequest):
    known_fault(request, "images_and_cameras_unchecked")
    encoder, frames = stage("encoder", option, FLOAT64, CPU), ball_frames()
    values = getattr(frames.cameras, name).clone()
    values[-1, -1, 0, 2] = bad
    broken = replace(frames, cameras=replace(frames.cameras, **{name: values}))

    refused(lambda: encoder(broken, KEYS, "current"), "cameras")
