"""Every renderer of conf/ on hard scenes: finite pictures and gradients, which do not depend on where the world is."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from tests.stability.hard_scenes import SCENES, SPACING, HardScene, Mode, cloud, is_finite, rotation
from tests.stability.known_faults import known_fault
from tests.stability.stages import matrix, moved_rays, options, particles_at, stage, variant, variants
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.testing.particle_sets import mapped, reordered
from vpd_lightning.testing.scenes import scene_rays
from vpd_lightning.types import Particles, Rays, RenderedRays

KEYS = RandomKeys(seed=1, step=2, sample_index=[0])
FLOAT64 = Mode("float64", torch.float64)


@pytest.fixture(params=options("renderer"))
def option(request: pytest.FixtureRequest) -> str:
    return request.param


def rays_for(scene: HardScene, mode: Mode, device: torch.device) -> Rays:
    """Return rays of the ordinary world, scaled and moved with it, one of them exactly through a particle."""
    scale = scene.spacing / SPACING
    shift = scene.points.mean(dim=0) - cloud().mean(dim=0) * scale if len(scene.points) == len(cloud()) else None
    rays = mapped_rays(scene_rays(batch_size=1, num_rays=10))
    rays = moved_rays(rays, mode, device, scale, shift)
    if len(scene.points):
        towards = scene.points[0].to(device, mode.dtype) - rays.origins[0, 0]
        if bool(towards.abs().max() > 0):
            directions = rays.directions.clone()
            directions[0, 0] = towards / towards.abs().max() / (towards / towards.abs().max()).norm()
            rays = Rays(rays.origins, directions)
    return rays


def mapped_rays(rays: Rays) -> Rays:
    return Rays(rays.origins.double(), rays.directions.double())


def rendered_with_gradients(
    renderer: nn.Module,
    particles: Particles,
    rays: Rays,
    mode: Mode,
    device: torch.device,
    keys: RandomKeys | None = KEYS,
) -> tuple[RenderedRays, list[Tensor]]:
    positions, features = particles.positions.clone(), particles.features.clone()
    inputs = [positions.requires_grad_(), features.requires_grad_()]
    with mode.context(device):
        rendered = renderer(replace(particles, positions=positions, features=features), rays, keys)
    total = rendered.rgbs.sum() + rendered.opacities.sum() + (rendered.depths - rendered.depths.detach()).sum()
    if rendered.coarse_rgbs is not None:
        total = total + rendered.coarse_rgbs.sum()
    weights = [p for p in renderer.parameters() if p.requires_grad]
    return rendered, list(torch.autograd.grad(total, [*inputs, *weights], materialize_grads=True))


def assert_a_picture(rendered: RenderedRays, mode: Mode) -> None:
    assert is_finite(rendered.rgbs, rendered.depths, rendered.opacities, rendered.coarse_rgbs)
    # A colour is a convex sum, rounded once per sample.
    for part in (rendered.rgbs, rendered.opacities):
        assert (part >= -100 * mode.eps).all() and (part <= 1 + 100 * mode.eps).all()
    assert rendered.rgbs.dtype == rendered.depths.dtype == mode.dtype


@pytest.mark.parametrize("choice, mode", matrix("renderer"))
def test_pictures_and_gradients_are_finite(choice: tuple[str, str], scene: HardScene, mode: Mode, device: torch.device):
    renderer = variant("renderer", choice, mode, device, scale=scene.spacing / SPACING)
    particles = particles_at(scene.points, mode, device)

    rendered, gradients = rendered_with_gradients(renderer, particles, rays_for(scene, mode, device), mode, device)

    assert_a_picture(rendered, mode)
    assert is_finite(*gradients)


@pytest.mark.parametrize("name", ["ordinary", "no_particle", "thousands_of_duplicates", "scaled_1e-06", "scaled_1e+06"])
def test_pictures_without_draws_are_finite(option: str, name: str, mode: Mode, device: torch.device):
    scene = SCENES[name]()
    renderer = stage("renderer", option, mode, device, scale=scene.spacing / SPACING).eval()

    with torch.no_grad(), mode.context(device):
        rendered = renderer(particles_at(scene.points, mode, device), rays_for(scene, mode, device), None)

    assert_a_picture(rendered, mode)


@pytest.mark.parametrize(
    "name", ["ordinary", "lattice_of_ties", "one_particle", "k_plus_1_particles", "translated_1000"]
)
def test_float32_pictures_are_those_of_float64(option: str, name: str, device: torch.device):
    mode, scene = Mode("float32", torch.float32), SCENES[name]()
    scene = replace(scene, points=scene.points.float().double())
    rays = rays_for(scene, mode, device)

    single = stage("renderer", option, mode, device).eval()(particles_at(scene.points, mode, device), rays, None)
    double = stage("renderer", option, FLOAT64, device).eval()
    double.load_state_dict(stage("renderer", option, mode, device).state_dict())
    twin = double(
        particles_at(scene.points.float(), FLOAT64, device), Rays(rays.origins.double(), rays.directions.double()), None
    )

    # A sample's place is known to eps of its coordinates (1e3 m: 6e-5 m, 1/800 of a bandwidth), and the features change
    # by about that share; the networks here have gains of about one.
    tolerance = 1e-4 if name != "translated_1000" else 2e-2
    if "global_nerf" in option:  # its ten octaves of the place multiply that error by up to 2^9
        tolerance = max(tolerance, 5e-3)
    torch.testing.assert_close(single.rgbs.double(), twin.rgbs, rtol=0, atol=tolerance)
    torch.testing.assert_close(single.opacities.double(), twin.opacities, rtol=0, atol=tolerance)


@pytest.mark.parametrize("density", [0.0, 1e6])
def test_all_empty_and_all_opaque_rays(option: str, density: float, mode: Mode, device: torch.device):
    renderer = stage("renderer", option, mode, device)
    for name, module in renderer.named_modules():
        if name.endswith("density"):
            with torch.no_grad():
                module.weight.zero_()
                module.bias.fill_(density if density else -1e6)
    particles = particles_at(cloud(), mode, device)
    rays = rays_for(SCENES["ordinary"](), mode, device)

    rendered, gradients = rendered_with_gradients(renderer, particles, rays, mode, device)

    assert_a_picture(rendered, mode)
    assert is_finite(*gradients)
    if "splat" not in option:  # its opacities come from a network without a density
        torch.testing.assert_close(
            rendered.opacities, torch.full_like(rendered.opacities, min(density, 1.0)), rtol=0, atol=1e-3
        )


@pytest.mark.parametrize("shift", [1e3, 1e6])
def test_a_translated_world_has_the_same_picture(option: str, shift: float, device: torch.device):
    if "global_nerf" in option:
        pytest.skip("it knows absolute places by design, and no particles")
    offset = shift * torch.tensor([1.0, -0.7, 0.4], dtype=torch.float64)
    renderer = stage("renderer", option, FLOAT64, device).eval()
    particles = particles_at(cloud(), FLOAT64, device)
    rays = rays_for(SCENES["ordinary"](), FLOAT64, device)

    here = renderer(particles, rays, None)
    there = renderer(
        replace(particles, positions=particles.positions + offset.to(device)),
        Rays(rays.origins + offset.to(device), rays.directions),
        None,
    )

    # float64 knows places to 1e-16 of the shift, 1e-10 m at most: 1e-8 of a bandwidth.
    torch.testing.assert_close(there.rgbs, here.rgbs, rtol=0, atol=1e-7)
    torch.testing.assert_close(there.depths, here.depths, rtol=0, atol=1e-7)


@pytest.mark.parametrize("choice, mode", matrix("renderer"))
@pytest.mark.parametrize("shift", [0.0, 100.0, 1e3])
def test_padding_does_not_matter_far_from_the_origin(
    choice: tuple[str, str], shift: float, mode: Mode, device: torch.device, request: pytest.FixtureRequest
):
    """Centring has to leave padding out, or products lose the digits that it was meant to keep."""
    known_fault(request, "padding_in_center", choice[1] == "brute_force" and shift == 1e3)
    offset = shift * torch.tensor([1.0, -0.7, 0.4], dtype=torch.float64)
    renderer = variant("renderer", choice, mode, device).eval()
    particles = particles_at(cloud() + offset, mode, device)
    rays = moved_rays(mapped_rays(scene_rays(1, 10)), mode, device, shift=offset)
    empty = mapped(particles, torch.zeros_like)

    names = ("positions", "features", "mask")
    padded = Particles(*(torch.cat([getattr(particles, name), *[getattr(empty, name)] * 3], dim=1) for name in names))

    with mode.context(device):
        alone, together = renderer(particles, rays, None), renderer(padded, rays, None)

    # The same particles are seen, in the same precision; sums may run in another order (bfloat16: see below).
    torch.testing.assert_close(together.rgbs, alone.rgbs, rtol=0, atol=0.02 if mode.is_autocast else 1e-4)


def test_a_rotated_world_has_the_same_densities(option: str, device: torch.device):
    if any(name in option for name in ("splat", "feature_network", "global_nerf")):
        pytest.skip("its network sees places, offsets or view directions in world axes by design")
    turn = rotation().to(device)
    renderer = stage("renderer", option, FLOAT64, device).eval()
    particles = particles_at(cloud(), FLOAT64, device)
    rays = rays_for(SCENES["ordinary"](), FLOAT64, device)

    here = renderer(particles, rays, None)
    there = renderer(
        replace(particles, positions=particles.positions @ turn.T),
        Rays(rays.origins @ turn.T, rays.directions @ turn.T),
        None,
    )

    # Colours depend on the view direction in world axes; density, and with it depth, sees distances alone.
    torch.testing.assert_close(there.opacities, here.opacities, rtol=0, atol=1e-8)
    torch.testing.assert_close(there.depths, here.depths, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", ["ordinary", "thousands_of_duplicates", "all_the_same", "on_a_line"])
def test_the_order_of_particles_does_not_matter(option: str, name: str, mode: Mode, device: torch.device):
    scene = SCENES[name]()
    renderer = stage("renderer", option, mode, device).eval()
    particles = particles_at(scene.points, mode, device)
    if name in (
        "thousands_of_duplicates",
        "all_the_same",
    ):  # among equals any may be chosen: make them equal altogether
        particles = replace(particles, features=torch.ones_like(particles.features))
    order = torch.randperm(len(scene.points), generator=torch.Generator().manual_seed(7)).to(device)
    rays = rays_for(scene, mode, device)

    with mode.context(device):
        here, there = (renderer(some, rays, None) for some in (particles, reordered(particles, order)))

    # Sums in another order; bfloat16 rounds the network's inputs to 2^-9, which may then differ by one step.
    torch.testing.assert_close(there.rgbs, here.rgbs, rtol=0, atol=0.02 if mode.is_autocast else 1e-5)


@pytest.mark.parametrize("option", ["surface", "splat"])
@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e3, 1e6])
def test_a_scaled_world_with_scaled_settings_stops_the_same_light(option: str, factor: float, device: torch.device):
    """Surface measures density per footprint, splat all lengths per surface scale: neither knows what a metre is."""
    base = stage("renderer", option, FLOAT64, device).eval()
    other = stage("renderer", option, FLOAT64, device, scale=factor).eval()
    rays = rays_for(SCENES["ordinary"](), FLOAT64, device)

    here = base(particles_at(cloud(), FLOAT64, device), rays, None)
    there = other(particles_at(cloud() * factor, FLOAT64, device), Rays(rays.origins * factor, rays.directions), None)

    torch.testing.assert_close(there.rgbs, here.rgbs, rtol=0, atol=1e-9)
    torch.testing.assert_close(there.depths / factor, here.depths, rtol=0, atol=1e-9)


@pytest.mark.parametrize("choice", variants("renderer"), ids="-".join)
def test_a_picture_repeats_bit_for_bit(choice: tuple[str, str], mode: Mode, device: torch.device):
    renderer = variant("renderer", choice, mode, device)
    particles, rays = particles_at(cloud(), mode, device), rays_for(SCENES["ordinary"](), mode, device)

    with torch.no_grad(), mode.context(device):
        first, second = (renderer(particles, rays, KEYS) for _ in range(2))

    assert torch.equal(first.rgbs, second.rgbs) and torch.equal(first.depths, second.depths)
